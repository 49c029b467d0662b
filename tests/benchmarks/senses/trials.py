"""Single trials of the benchmark: one robot, one lie, and how far it drives."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.base import KEYS, TICK_S, Velocity
from schemas.rpc import ResetRequest
from services.experiments.evaluation.drives import drive, drive_of
from services.experiments.evaluation.plan import TEACHING_SEED
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from smal.features import FeatureSettings
from smal.model import Model
from smal.obstacles.clearance import Mount
from smal.robot import Robot
from smal.teaching.mapping import learn
from tests.benchmarks.senses.lies import Lie, lying

FEATURES: Final = FeatureSettings()
DRIVES_TICKS: Final = 80  # Frames that a person drives straight ahead.
STANDS_TICKS: Final = 10  # Frames without movement after which a robot counts as standing, 1 s.
WATCHED_TICKS: Final = 60  # Frames after a lie of the camera or of the wheels.
MOST_TICKS: Final = 400
_STILL_M: Final = 0.01  # Movement in a frame that counts as none, metres.


@dataclass(frozen=True)
class Trial:
    """The result of one trial."""

    touched: bool  # Whether it touched anything after the lie began.
    driven_m: float  # Path after the first lie.
    stood_s: float  # Time from the first lie until it stood; infinity if it never did.
    moved_later_m: float  # Path after it first stood.
    outcome: str | None = None
    contradicted: bool = False  # Whether a check of the senses stopped it.


def teach(simulation: Simulation) -> Model:
    """Learn a model of one drive of the expert."""
    return learn([drive_of(drive(simulation, FEATURES, TEACHING_SEED))])


def by_hand(
    simulation: Simulation, lie: Lie | None, mount: Mount | None, seed: int, since: int
) -> Trial:
    """Drive straight ahead at full speed from a place by chance, in a direction by chance."""
    turn = np.random.default_rng(seed).uniform(-math.pi, math.pi)
    request = ResetRequest(
        seed=seed, purpose="run", driver="teleop", start="anywhere", until_said=True
    )
    return _trial(simulation, lie, mount, request, since, _Person(turn), DRIVES_TICKS)


def by_itself(simulation: Simulation, lie: Lie | None, mount: Mount | None, seed: int, since: int, model: Model,
              *, obstacles: int = 0, anywhere: bool = False, most: int = MOST_TICKS) -> Trial:  # fmt: skip
    """Let the robot search by itself; the trial ends with its word, or after ``most`` frames."""
    request = ResetRequest(
        seed=seed,
        purpose="run",
        until_said=True,
        obstacles=obstacles,
        start="anywhere" if anywhere else "start",
    )
    return _trial(
        simulation, lie, mount, request, since, _Policy(Robot(model, seed=seed), mount), most
    )


class _Person:
    """Turns on the spot by an angle, then drives ahead; the time of the turn counts before the lie."""

    def __init__(self, turn_rad: float) -> None:
        self._turn_rad = turn_rad

    def asks(self, episode: LockstepEpisode) -> Velocity:
        step_rad = episode.kinematics.turn_rate_rad_s * TICK_S
        if abs(self._turn_rad) > step_rad:
            self._turn_rad -= math.copysign(step_rad, self._turn_rad)
            return Velocity(0.0, math.copysign(1.0, self._turn_rad))
        return KEYS["forward"]

    @property
    def turning(self) -> bool:
        return abs(self._turn_rad) > 0.1

    said = None


class _Policy:
    turning = False

    def __init__(self, robot: Robot, mount: Mount | None) -> None:
        self._robot = robot
        self._mount = mount

    def asks(self, episode: LockstepEpisode) -> Velocity:
        view = episode.view
        depth = None if view.depth is None or self._mount is None else (view.depth, self._mount)
        return Velocity(*self._robot.step(view.image, rounded(view.odometry)[:3], depth=depth))

    @property
    def said(self) -> str | None:
        return self._robot.said


def _trial(
    simulation: Simulation, lie: Lie | None, mount: Mount | None, request: ResetRequest, since: int,
    driver: _Person | _Policy, most: int,
) -> Trial:  # fmt: skip
    simulation.mount = mount
    honest = Lie("none")
    # A lie from the start is there before the person has turned.
    begin = (
        math.inf if lie is None else since + (_turning_ticks(driver, simulation) if since else 0)
    )
    with lying(simulation, lie or honest, int(min(begin, 10**9))):
        episode = LockstepEpisode(simulation, request)
        poses = [simulation.pose]
        outcome = None
        for _ in range(most):
            asked = driver.asks(episode)
            outcome = driver.said or episode.outcome
            if outcome is not None:
                break
            episode.step(asked)
            poses.append(simulation.pose)
    steps = np.hypot(*np.diff([(one.x, one.y) for one in poses], axis=0).T)
    after = np.append(steps[int(min(begin, len(steps))) :], math.inf)  # The end is no standing.
    still = (
        np.convolve(after < _STILL_M, np.ones(STANDS_TICKS), "full")[STANDS_TICKS - 1 :]
        == STANDS_TICKS
    )
    stood = int(still.argmax()) if still.any() else None
    return Trial(
        touched=simulation.collided,
        driven_m=float(after[:-1].sum()),
        stood_s=math.inf if stood is None else stood * TICK_S,
        moved_later_m=0.0 if stood is None else float(after[stood:-1].sum()),
        outcome=outcome,
        contradicted=episode.contradiction is not None,
    )


def _turning_ticks(driver: _Person | _Policy, simulation: Simulation) -> int:
    if isinstance(driver, _Policy):
        return 0
    return int(abs(driver._turn_rad) / (simulation.world.robot.drive.turn_rate_rad_s * TICK_S))
