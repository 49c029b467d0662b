"""One search in this process: the same objects as the services use, in lockstep, without messages between them.

Image, features, controller, movement, tick after tick. What the services add changes nothing in lockstep: between
simulator and features the image is raw (JPEG is for recordings and people), the world waits for the answer to every
frame, and the answer is carried out from that frame on. So the same seed gives the same poses (a test says so).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import Atom as AtomName
from schemas.rpc import ResetRequest, Start
from services.experiments.evaluation.controllers import Controller, Place, seen_by
from services.experiments.evaluation.degradation import CLEAN, Degradation, Degrader
from services.robot.episode import RunOutcome
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from services.simulator.world.route import route_length_m
from smal.movement import Atom

#: Frames after which a search times out, at least, in `smal run`.
MAX_TICKS: Final = 3000
_NAMES: Final[dict[Atom, AtomName]] = {
    Atom.STOP: "stop",
    Atom.FORWARD: "forward",
    Atom.BACKWARD: "backward",
    Atom.LEFT: "left",
    Atom.RIGHT: "right",
}


@dataclass(frozen=True, eq=False)
class Search:
    """What happened in one search.

    Attributes
    ----------
    seed
        Of the episode.
    outcome
        How it ended: "found", "collision", "timeout", or "false_goal": the robot said that it was there, and was not.
    ticks
        Frames that passed; frame 0 is the start.
    decisions
        Kind of every decision, by tick; empty for a controller that makes none.
    unrecognized
        Ticks of the decisions that were taken without a recognized state.
    poses
        (ticks + 1, 3) float64: x, y in metres, heading in radians.
    atoms
        (ticks,) int8, what was done from each frame to the next, `smal.paper.action_space.Atom`.
    places
        Where the robot believed to be at every frame, for a controller that says so.
    shortest_m
        Of the way from the start to where the victim counts as found.
    pictures
        What the robot saw at chosen ticks, (height, width, 3) uint8 RGB.
    kidnap_tick
        Frame at which it was carried away; 0 for never.
    """

    seed: int
    outcome: RunOutcome
    ticks: int
    decisions: dict[int, str]
    unrecognized: frozenset[int]
    poses: NDArray[np.float64]
    atoms: NDArray[np.int8]
    shortest_m: float
    places: tuple[Place | None, ...] = ()
    pictures: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    kidnap_tick: int = 0

    @property
    def driven_m(self) -> float:
        """Way driven; being carried is none."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        if 0 < self.kidnap_tick <= len(steps):
            steps[self.kidnap_tick - 1] = 0.0
        return float(steps.sum())

    @property
    def unknown(self) -> int:
        """Decisions that were taken without a recognized state."""
        return len(self.unrecognized)


def search(
    simulation: Simulation,
    controller: Controller,
    seed: int,
    *,
    degradation: Degradation = CLEAN,
    start: Start = "start",
    kidnap_tick: int = 0,
    max_ticks: int = MAX_TICKS,
    keep: Callable[[int], bool] = lambda _tick: False,
) -> Search:
    """Let a controller search for the victim.

    Parameters
    ----------
    simulation
        Its world and camera; where the degradation shakes the camera, opened with that shake.
    controller
        Who drives; reset before the first frame.
    seed
        Of the start, the wheels and the shake, as in `smal run`; also of the degradation.
    degradation
        Of the images that the controller sees.
    start
        Where it begins, as in `smal run`.
    kidnap_tick
        Frame at which the robot is carried away; 0 for never.
    max_ticks
        Frames after which the search times out, at least 1.
    keep
        Of which ticks to keep the picture.
    """
    degrader = Degrader(degradation, seed)
    request = ResetRequest(seed=seed, purpose="run", start=start, kidnap_tick=kidnap_tick or None, max_ticks=max_ticks)
    episode = LockstepEpisode(simulation, request)
    controller.reset()
    # The search ends where the victim counts as found.
    shortest_m = max(route_length_m(np.array(episode.beginning.route)) - simulation.found_m, 0.0)
    poses = [episode.view.pose]
    atoms: list[int] = []
    decisions: dict[int, str] = {}
    unrecognized: set[int] = set()
    places: list[Place | None] = []
    pictures: dict[int, NDArray[np.uint8]] = {}
    outcome: RunOutcome | None = None
    while outcome is None:
        tick, view = episode.tick, episode.view
        image = degrader.apply(tick, view.image)
        if keep(tick):
            pictures[tick] = image
        move = controller.act(seen_by(controller, tick, image, rounded(view.odometry)[:3]))
        places.append(move.place)
        if move.decision is not None:
            decisions[tick] = move.decision
            if not move.recognized:
                unrecognized.add(tick)
            if move.arrived:
                outcome = "found" if episode.reached else "false_goal"
                break
        poses.append(episode.step(_NAMES[move.atom]).pose)
        atoms.append(move.atom)
        outcome = episode.outcome
    last = len(atoms)
    if keep(last):
        pictures[last] = degrader.apply(last, episode.view.image)
    return Search(
        seed,
        outcome,
        last,
        decisions,
        frozenset(unrecognized),
        np.array([[pose.x, pose.y, pose.heading] for pose in poses]),
        np.array(atoms, dtype=np.int8),
        shortest_m,
        tuple(places),
        pictures,
        kidnap_tick,
    )
