"""The robot with mass: drives as commanded on dry ground, slips where it must, stops at walls, repeats exactly."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import ATOMS, KEYS, TICK_S, Atom, Velocity
from services.robot.gate import MAX_AGE_S
from services.simulator.base import STEP_S, Base, KinematicBase, Motion
from services.simulator.physics import PhysicalBase
from services.simulator.robots import RESCUEBOT, TURTLEBOT, DriveTrain, RobotModel
from services.simulator.world.place import Pose, Solid

robots = pytest.mark.parametrize("robot", [RESCUEBOT, TURTLEBOT], ids=["rescuebot", "turtlebot"])


class Hall:
    """A floor with a few things on it."""

    bounds = (-200.0, -200.0, 200.0, 200.0)

    def __init__(self, *things: Solid, model: RobotModel = RESCUEBOT) -> None:
        self.solids = things
        self.robot = model


def perfect(robot: RobotModel) -> DriveTrain:
    return replace(robot.drive, tick_sigma=0.0, radius_sigma=0.0)


def standing(base: Base, pose: Pose = Pose(0.0, 0.0, 0.0), seed: int = 0) -> Base:  # noqa: B008 - frozen
    base.put(pose, np.random.default_rng(seed))
    return base


def drive(base: Base, atom: Atom, duration_s: float, speed: float = 1.0) -> list[Motion]:
    return [
        base.step(Velocity(*(speed * share for share in KEYS[atom])), 0.02)
        for _ in range(round(duration_s / 0.02))
    ]


def way(begin: Pose, end: Pose) -> float:
    return math.hypot(end.x - begin.x, end.y - begin.y)


def turned(begin: Pose, end: Pose) -> float:
    return math.remainder(end.heading - begin.heading, math.tau)


@robots
@pytest.mark.parametrize("speed", [1.0, 0.1])
@pytest.mark.parametrize("atom", ["backward", "left"])
def test_at_speed_it_moves_as_the_kinematic_base_does(
    robot: RobotModel, speed: float, atom: Atom
) -> None:
    place = Hall(model=robot)
    moved = {}
    for base in (PhysicalBase(place, perfect(robot)), KinematicBase(place, perfect(robot))):
        begin = drive(standing(base, Pose(3.0, -7.0, 0.4)), atom, 1.0, speed)[-1].pose
        motions = drive(base, atom, 1.0, speed)
        moved[type(base)] = way(begin, motions[-1].pose), turned(begin, motions[-1].pose)
        headings = [begin.heading, *(motion.pose.heading for motion in motions)]
        assert abs(np.diff(np.diff(np.unwrap(headings)))).max() < 5e-3, "the heading does not shake"
        assert not any(motion.collided for motion in motions)
    (real_way, real_turn) = moved[PhysicalBase]
    (ideal_way, ideal_turn) = moved[KinematicBase]
    assert real_way == pytest.approx(ideal_way, rel=0.01, abs=2e-3)
    assert real_turn == pytest.approx(ideal_turn, rel=0.03, abs=5e-3)


@robots
@pytest.mark.parametrize("atom", ["forward", "left"])
def test_robot_stands_within_half_a_second_of_silence(robot: RobotModel, atom: Atom) -> None:
    """The gate obeys a command for `MAX_AGE_S`. Standing means less than 5 % of the usual motion a tick."""
    base = standing(PhysicalBase(Hall(model=robot), perfect(robot)))
    drive(base, atom, 2.0)
    before = drive(base, "stop", 0.5 - MAX_AGE_S + STEP_S)[-1].pose
    after = drive(base, "stop", TICK_S)[-1].pose
    assert way(before, after) <= 0.05 * robot.drive.speed_m_s * TICK_S
    assert abs(turned(before, after)) <= 0.05 * robot.drive.turn_rate_rad_s * TICK_S


WALL = Solid(shapely.box(2.0, -3.0, 2.5, 3.0), 0.0, 2.0, opaque=True)


@robots
def test_a_wall_stops_the_robot_and_lets_it_back_off(robot: RobotModel) -> None:
    base = standing(PhysicalBase(Hall(WALL, model=robot), perfect(robot)))
    needed_s = 2.0 / robot.drive.speed_m_s + 1.0
    motions = drive(base, "forward", needed_s)
    first = next(i for i, motion in enumerate(motions) if motion.collided)
    for motion in motions:
        assert motion.pose.x < 2.0 - robot.radius_m + 5e-3
    assert motions[first].pose.x == pytest.approx(2.0 - robot.radius_m, abs=0.01)
    assert not any(motion.collided for motion in motions[:first])
    assert sum(sum(motion.rolled_m) / 2 for motion in motions) > motions[-1].pose.x + 0.1, (
        "the wheels spin at it"
    )
    backing = drive(base, "backward", 1.5)
    assert not backing[-1].collided
    assert motions[-1].pose.x - backing[-1].pose.x > 0.5 * robot.drive.speed_m_s


def trace(base: PhysicalBase, seed: int, atoms: list[Atom]) -> list[Motion]:
    standing(base, Pose(0.0, 0.0, 0.1 * seed), seed)
    return [motion for atom in atoms for motion in drive(base, atom, 0.5)]


@given(
    first=st.lists(st.sampled_from(ATOMS), max_size=10),
    seeds=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    second=st.lists(st.sampled_from([*ATOMS, "forward"]), min_size=6, max_size=12),
)
@settings(max_examples=5)
def test_episode_repeats_exactly(
    first: list[Atom], seeds: tuple[int, int], second: list[Atom]
) -> None:
    corner = Solid(
        shapely.LineString([(-1.5, -2.0), (1.5, -2.0), (1.5, 2.0), (-1.5, 2.0)]),
        0.0,
        1.0,
        opaque=False,
    )
    used = PhysicalBase(Hall(corner, WALL))
    trace(used, seeds[0], ["forward", *first])
    assert trace(used, seeds[1], second) == trace(
        PhysicalBase(Hall(corner, WALL)), seeds[1], second
    )
