"""The robot with mass: drives as commanded on dry ground, slips where it must, stops at walls, repeats exactly."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import ATOMS, Atom
from services.robot.clock import TICK_S
from services.robot.gate import MAX_AGE_S
from services.simulator.base import STEP_S, Base, KinematicBase, Motion
from services.simulator.drive import WheelSpeeds, move
from services.simulator.physics import engine
from services.simulator.physics.articulation import TYRE_FRICTION
from services.simulator.physics.collision_shapes import hull, upright_sides
from services.simulator.physics.engine import PhysicsUnavailableError
from services.simulator.physics.motors import (
    ACCELERATION_M_S2,
    BRAKING_M_S2,
    STANDING,
    STOPPING_M_S2,
    TURN_ACCELERATION_RAD_S2,
    lead,
)
from services.simulator.physics.physical_base import PhysicalBase
from services.simulator.robots import RESCUEBOT, TURTLEBOT, Drive, RobotModel
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import Place, Pose, Scale, Solid
from tests.services.simulator.simulator_driving import StubCamera, drive_to

GRAVITY = 9.81
YARD = load_world("yard")
robots = pytest.mark.parametrize("robot", [RESCUEBOT, TURTLEBOT], ids=lambda robot: robot.name)


@dataclass(frozen=True, eq=False)
class Hall(Place):
    """A floor with a few things on it."""

    model: RobotModel = RESCUEBOT
    things: tuple[Solid, ...] = ()

    @property
    def robot(self) -> RobotModel:
        return self.model

    @property
    def scale(self) -> Scale:
        return Scale()

    @property
    def solids(self) -> tuple[Solid, ...]:
        return self.things

    @property
    def lanes(self) -> tuple[shapely.LineString, ...]:
        return ()


def hall(*things: Solid, model: RobotModel = RESCUEBOT) -> Hall:
    return Hall("hall", (-200.0, -200.0, 200.0, 200.0), model, things)


def perfect(robot: RobotModel) -> Drive:
    return replace(robot.drive, tick_sigma=0.0, radius_sigma=0.0)


def standing(base: Base, pose: Pose = Pose(0.0, 0.0, 0.0), seed: int = 0) -> Base:  # noqa: B008 - frozen
    base.put(pose, np.random.default_rng(seed))
    return base


def drive(base: Base, atom: Atom, duration_s: float, speed: float = 1.0) -> list[Motion]:
    return [base.step(atom, speed, 0.02) for _ in range(round(duration_s / 0.02))]


def way(begin: Pose, end: Pose) -> float:
    return math.hypot(end.x - begin.x, end.y - begin.y)


def turned(begin: Pose, end: Pose) -> float:
    return math.remainder(end.heading - begin.heading, math.tau)


@robots
@pytest.mark.parametrize("speed", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("atom", ["forward", "backward", "left", "right"])
def test_at_speed_it_moves_as_the_kinematic_base_does(robot: RobotModel, speed: float, atom: Atom) -> None:
    place = hall(model=robot)
    moved = {}
    for base in (PhysicalBase(place, perfect(robot)), KinematicBase(place, perfect(robot))):
        begin = drive(standing(base, Pose(3.0, -7.0, 0.4)), atom, 1.0, speed)[-1].pose
        motions = drive(base, atom, 1.0, speed)
        moved[type(base)] = way(begin, motions[-1].pose), turned(begin, motions[-1].pose)
        headings = [begin.heading, *(motion.pose.heading for motion in motions)]
        assert abs(np.diff(np.diff(np.unwrap(headings)))).max() < 5e-3, "the heading does not shake"
        assert not any(motion.collided for motion in motions)
    (real_way, real_turn), (ideal_way, ideal_turn) = moved[PhysicalBase], moved[KinematicBase]
    assert real_way == pytest.approx(ideal_way, rel=0.01, abs=2e-3)
    assert real_turn == pytest.approx(ideal_turn, rel=0.03, abs=5e-3)


@robots
def test_it_drives_straight(robot: RobotModel) -> None:
    end = drive(standing(PhysicalBase(hall(model=robot), perfect(robot))), "forward", 5.0)[-1].pose
    assert abs(end.y) < 0.005 * end.x


@robots
@pytest.mark.parametrize("before", [None, *ATOMS])
def test_a_standing_robot_stays_for_a_minute(robot: RobotModel, before: Atom | None) -> None:
    base = standing(PhysicalBase(hall(model=robot)), Pose(40.0, -60.0, 2.0))
    if before is not None:
        drive(base, before, 0.5)
    rest = drive(base, "stop", 1.0)[-1].pose
    motions = drive(base, "stop", 60.0)
    assert {motion.pose for motion in motions} == {rest}
    assert {motion.rolled_m for motion in motions} == {(0.0, 0.0)}
    assert drive(base, "forward", 0.3)[-1].pose != rest, "it wakes at a command"


@robots
def test_braking_is_quick_but_no_quicker_than_friction_allows(robot: RobotModel) -> None:
    base = standing(PhysicalBase(hall(model=robot), perfect(robot)))
    begin = drive(base, "forward", 2.0)[-1].pose
    speed = robot.drive.speed_m_s
    end = drive(base, "stop", speed / STOPPING_M_S2 + 0.06)[-1].pose
    assert way(begin, end) >= speed**2 / (2 * TYRE_FRICTION * GRAVITY)
    assert way(begin, end) == pytest.approx(speed**2 / (2 * STOPPING_M_S2), rel=0.35, abs=0.01)
    later = drive(base, "stop", 1.0)[-1].pose
    assert way(end, later) < 0.01, "what is left is rocking back onto the rear caster"


@robots
@pytest.mark.parametrize("atom", ["forward", "backward", "left"])
def test_silence_means_that_the_robot_stands_within_half_a_second(robot: RobotModel, atom: Atom) -> None:
    """The gate obeys a command for so long from its frame on, and none comes sooner than a cycle after its frame.

    A robot stands that moves by less than 5 % of what it usually does in a tick.
    """
    base = standing(PhysicalBase(hall(model=robot), perfect(robot)))
    drive(base, atom, 2.0)
    before = drive(base, "stop", 0.5 - MAX_AGE_S + STEP_S)[-1].pose
    after = drive(base, "stop", TICK_S)[-1].pose
    assert way(before, after) <= 0.05 * robot.drive.speed_m_s * TICK_S
    assert abs(turned(before, after)) <= 0.05 * robot.drive.turn_rate_rad_s * TICK_S


def test_on_ice_the_wheels_spin_and_friction_bounds_the_way() -> None:
    friction, duration_s = 0.05, 1.0
    base = standing(PhysicalBase(hall(), perfect(RESCUEBOT), friction=friction))
    motions = drive(base, "forward", duration_s)
    rolled_m = sum(sum(motion.rolled_m) / 2 for motion in motions)
    real_m = motions[-1].pose.x
    assert 0.1 < real_m <= friction * GRAVITY * duration_s**2 / 2 * 1.01
    assert rolled_m > 4 * real_m


@robots
@given(atoms=st.lists(st.sampled_from(ATOMS), min_size=1, max_size=8))
@settings(max_examples=10, deadline=None)
def test_on_dry_ground_the_wheels_tell_the_way(robot: RobotModel, atoms: list[Atom]) -> None:
    base = standing(PhysicalBase(hall(model=robot)))
    reckoned = Pose(0.0, 0.0, 0.0)
    rolled_m = 0.0
    for atom in atoms:
        for motion in drive(base, atom, 0.4):
            left, right = motion.rolled_m
            rolled_m += (abs(left) + abs(right)) / 2
            reckoned = move(reckoned, WheelSpeeds(left / 0.02, right / 0.02), robot.drive.track_m, 0.02)
            real = motion.pose
    # The tyres creep where a change of speed and one of direction come together, and slide in a stop at full speed
    # astern, since the weight is then on the caster.
    slides = max(1, sum(one == "backward" != other for one, other in pairwise([*atoms, "stop"])))
    assert way(reckoned, real) < 0.03 * rolled_m + 0.015 + 0.03 * robot.drive.speed_m_s * slides
    assert abs(turned(reckoned, real)) < 0.02 * (len(atoms) + 1)


def test_negative_friction_is_refused() -> None:
    with pytest.raises(ValueError, match=r"friction=-0\.1"):
        PhysicalBase(hall(), friction=-0.1)


@given(
    now=st.tuples(*[st.floats(-3, 3)] * 2),
    wanted=st.tuples(*[st.floats(-3, 3)] * 2),
    track_m=st.floats(0.1, 1.0),
)
def test_the_controller_leads_within_its_limits_and_arrives(
    now: tuple[float, float], wanted: tuple[float, float], track_m: float
) -> None:
    here, goal = WheelSpeeds(*now), WheelSpeeds(*wanted)
    duration_s = 0.01
    ahead = lead(here, goal, track_m, duration_s)
    mean_change = (ahead.left + ahead.right - here.left - here.right) / 2
    turn_change = (ahead.right - ahead.left - here.right + here.left) / track_m
    astern, ahead_most = (STOPPING_M_S2,) * 2 if goal == STANDING else (BRAKING_M_S2, ACCELERATION_M_S2)
    assert -astern * duration_s - 1e-9 <= mean_change <= ahead_most * duration_s + 1e-9
    assert abs(turn_change) <= TURN_ACCELERATION_RAD_S2 * duration_s + 1e-9
    mean_way = abs(goal.left + goal.right - here.left - here.right) / 2
    turn_way = abs(goal.right - goal.left - here.right + here.left) / track_m
    needed = max(mean_way / ACCELERATION_M_S2, turn_way / TURN_ACCELERATION_RAD_S2) / duration_s
    for _ in range(math.ceil(needed) + 1):
        here = lead(here, goal, track_m, duration_s)
    assert here == pytest.approx(goal, abs=1e-9)


WALL = Solid(shapely.box(2.0, -3.0, 2.5, 3.0), 0.0, 2.0, opaque=True)


@robots
def test_a_wall_stops_the_robot_and_lets_it_back_off(robot: RobotModel) -> None:
    base = standing(PhysicalBase(hall(WALL, model=robot), perfect(robot)))
    needed_s = 2.0 / robot.drive.speed_m_s + 1.0
    motions = drive(base, "forward", needed_s)
    first = next(i for i, motion in enumerate(motions) if motion.collided)
    for motion in motions:
        assert motion.pose.x < 2.0 - robot.radius_m + 5e-3
    assert motions[first].pose.x == pytest.approx(2.0 - robot.radius_m, abs=0.01)
    assert not any(motion.collided for motion in motions[:first])
    assert sum(sum(motion.rolled_m) / 2 for motion in motions) > motions[-1].pose.x + 0.1, "the wheels spin at it"
    backing = drive(base, "backward", 1.5)
    assert not backing[-1].collided
    assert motions[-1].pose.x - backing[-1].pose.x > 0.5 * robot.drive.speed_m_s


@given(
    seed=st.integers(0, 10_000),
    x=st.floats(-14, 14),
    y=st.floats(-9, 9),
    heading=st.floats(-3.1, 3.1),
    atoms=st.lists(st.sampled_from([*ATOMS, "forward", "forward"]), min_size=3, max_size=10),
)
@settings(max_examples=40, deadline=None)
def test_the_robot_never_enters_anything(seed: int, x: float, y: float, heading: float, atoms: list[Atom]) -> None:
    obstacles = obstacles_of(YARD.place)
    if not obstacles.is_free(x, y, YARD.robot.radius_m + 0.05):
        return
    base = standing(YARD_BASE, Pose(x, y, heading), seed)
    for atom in atoms:
        for motion in drive(base, atom, 0.5):
            clearance = obstacles.clearance(motion.pose.x, motion.pose.y)
            assert clearance > YARD.robot.radius_m - 0.005
            # Lines are 2 cm thick, and the engine feels a wall one step ahead.
            assert not motion.collided or clearance < YARD.robot.radius_m + 0.03


YARD_BASE = PhysicalBase(YARD.place)


def trace(base: PhysicalBase, seed: int, atoms: list[Atom]) -> list[Motion]:
    standing(base, Pose(0.0, 0.0, 0.1 * seed), seed)
    return [motion for atom in atoms for motion in drive(base, atom, 0.5)]


@given(
    first=st.lists(st.sampled_from(ATOMS), max_size=10),
    seeds=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    second=st.lists(st.sampled_from([*ATOMS, "forward"]), min_size=6, max_size=12),
)
@settings(max_examples=15, deadline=None)
def test_an_episode_repeats_exactly_whatever_was_before(
    first: list[Atom], seeds: tuple[int, int], second: list[Atom]
) -> None:
    corner = Solid(shapely.LineString([(-1.5, -2.0), (1.5, -2.0), (1.5, 2.0), (-1.5, 2.0)]), 0.0, 1.0, opaque=False)
    used = PhysicalBase(hall(corner, WALL))
    trace(used, seeds[0], ["forward", *first])
    assert trace(used, seeds[1], second) == trace(PhysicalBase(hall(corner, WALL)), seeds[1], second)


def test_seeds_differ() -> None:
    ends = {drive(standing(YARD_BASE, YARD.start, seed), "forward", 1.0)[-1].pose for seed in range(5)}
    assert len(ends) == 5


@given(
    atoms=st.lists(st.sampled_from(ATOMS), min_size=1, max_size=12),
    slice_s=st.sampled_from([0.02, 0.01, 0.005, 0.004, 0.002]),
)
@settings(max_examples=20, deadline=None)
def test_the_way_does_not_depend_on_how_time_is_sliced(atoms: list[Atom], slice_s: float) -> None:
    place = hall(WALL)
    whole, sliced = (standing(PhysicalBase(place, perfect(RESCUEBOT))) for _ in range(2))
    for atom in atoms:
        coarse = drive(whole, atom, 0.1)
        fine = [sliced.step(atom, 1.0, slice_s) for _ in range(round(0.1 / slice_s))]
        assert fine[-1].pose == coarse[-1].pose
        rolled_m = [np.sum([motion.rolled_m for motion in motions], axis=0) for motions in (fine, coarse)]
        np.testing.assert_allclose(*rolled_m, atol=1e-9)


def test_what_is_left_of_a_step_is_not_lost() -> None:
    odd, even = (standing(PhysicalBase(hall(), perfect(RESCUEBOT))) for _ in range(2))
    odd_motions = [odd.step("forward", 1.0, 0.007) for _ in range(40)]
    assert odd_motions[-1].pose == drive(even, "forward", 0.28)[-1].pose


def test_courtyards_are_open_and_have_walls() -> None:
    yard = shapely.box(-10, -10, 10, 10).difference(shapely.box(-3, -3, 3, 3))
    base = standing(PhysicalBase(hall(Solid(yard, 0.0, 8.0, opaque=True)), perfect(RESCUEBOT)))
    motions = drive(base, "forward", 3.0)
    free = [motion for motion in motions if motion.pose.x < 2.5]
    assert free
    assert not any(motion.collided for motion in free)
    assert motions[-1].collided
    assert motions[-1].pose.x == pytest.approx(3.0 - RESCUEBOT.radius_m, abs=0.01)


@pytest.mark.parametrize(("low_m", "hit"), [(1.05, False), (0.9, True), (0.3, True)])
def test_what_hangs_is_driven_under_if_the_mast_fits(low_m: float, hit: bool) -> None:
    bridge = Solid(shapely.box(2.0, -3.0, 4.0, 3.0), low_m, 6.0, opaque=True)
    motions = drive(standing(PhysicalBase(hall(bridge))), "forward", 4.0)
    assert any(motion.collided for motion in motions) == hit
    assert (motions[-1].pose.x > 5.0) == (not hit)


def test_a_robot_that_topples_has_collided() -> None:
    pole = replace(
        RESCUEBOT, radius_m=0.1, height_m=2.5, drive=replace(RESCUEBOT.drive, track_m=0.1, wheel_radius_m=0.05)
    )
    base = standing(PhysicalBase(hall(model=pole)))
    assert not any(motion.collided for motion in drive(base, "stop", 1.0))
    motions = drive(base, "forward", 1.0) + drive(base, "stop", 2.0)
    assert motions[-1].collided


polygons = st.builds(
    lambda x, y, radius, corners, hole: shapely.Point(x, y)
    .buffer(radius, quad_segs=corners)
    .difference(shapely.Point(x, y).buffer(hole * radius, quad_segs=corners)),
    st.floats(-50, 50), st.floats(-50, 50), st.floats(2, 60), st.integers(1, 6), st.sampled_from([0.0, 0.3, 0.7]),
)  # fmt: skip


@given(polygon=polygons, low_m=st.floats(0, 0.4), height_m=st.floats(0.5, 20))
@settings(max_examples=50, deadline=None)
def test_sides_cover_the_outline_and_face_outwards(polygon: shapely.Polygon, low_m: float, height_m: float) -> None:
    mesh = upright_sides([Solid(polygon, low_m, low_m + height_m, opaque=True)], under_m=0.45)
    corners = mesh.vertices[mesh.triangles].astype(float)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    seen_m = min(low_m + height_m, 0.45 + 1.0) - low_m
    assert twice_area.sum() / 2 == pytest.approx(polygon.length * seen_m, rel=1e-4)
    normals = cross / twice_area[:, None]
    assert abs(normals[:, 2]).max() < 1e-5
    middle = (corners.min(axis=1) + corners.max(axis=1))[:, :2] / 2
    assert not shapely.contains_xy(polygon, *(middle + 1e-3 * normals[:, :2]).T).any()
    assert shapely.contains_xy(polygon, *(middle - 1e-3 * normals[:, :2]).T).all()


def test_lines_points_and_collections_have_sides_and_the_lofty_has_none() -> None:
    shapes = [
        shapely.LineString([(0, 0), (5, 0)]),
        shapely.LinearRing([(0, 0), (5, 0), (5, 5)]),
        shapely.Point(1, 1),
        shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(2, 2, 3, 3)]),
        shapely.GeometryCollection([shapely.Point(0, 0), shapely.box(0, 0, 1, 1)]),
    ]
    for shape in shapes:
        mesh = upright_sides([Solid(shape, 0.0, 1.0, opaque=False)], under_m=0.5)
        x_min, y_min, x_max, y_max = shape.bounds
        assert len(mesh.triangles) >= 8
        found = [*mesh.vertices.min(axis=0), *mesh.vertices.max(axis=0)]
        assert found == pytest.approx([x_min, y_min, 0, x_max, y_max, 1], abs=0.03)
    assert len(upright_sides([Solid(shapes[0], 0.5, 1.0, opaque=False)], under_m=0.5).triangles) == 0


@robots
def test_the_hull_and_the_wheels_fit_into_the_robots_circle(robot: RobotModel) -> None:
    corners = hull(robot.radius_m, 0.02, robot.height_m)
    reach = np.linalg.norm(corners[:, :2], axis=1)
    assert reach == pytest.approx(np.full(len(corners), robot.radius_m))
    assert math.hypot(robot.drive.track_m / 2, robot.drive.wheel_radius_m) < robot.radius_m * math.cos(math.pi / 32)


def test_a_missing_engine_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    engine.load.cache_clear()
    monkeypatch.setitem(sys.modules, "sapien", None)
    with pytest.raises(PhysicsUnavailableError, match=r"cannot be loaded .*pip install -e '.\[simulator\]'") as caught:
        PhysicalBase(hall())
    assert "\n" not in str(caught.value)
    assert engine.load.cache_info().currsize == 0, "a failure is not remembered"


def test_it_drives_without_a_vulkan_driver() -> None:
    script = (
        "import numpy as np; from services.simulator.world import load_world;"
        "from services.simulator.physics.physical_base import PhysicalBase;"
        "world = load_world('yard'); base = PhysicalBase(world.place);"
        "base.put(world.start, np.random.default_rng(0));"
        "print(sum(base.step('forward', 1.0, 0.02).rolled_m[0] for _ in range(25)))"
    )
    environment = {**os.environ, "VK_DRIVER_FILES": "missing.json", "VK_ICD_FILENAMES": "missing.json"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert float(done.stdout) > 0.4


def town(buildings: int) -> Hall:
    """Return houses with courtyards in rows, 20 m apart."""
    rng = np.random.default_rng(0)
    houses = []
    for number in range(buildings):
        angles = np.sort(rng.uniform(0, math.tau, 16))
        ring = np.column_stack([np.cos(angles), np.sin(angles)])
        centre = 40.0 * np.array([number % 32, number // 32])
        houses.append(Solid(shapely.Polygon(centre + 10 * ring, [centre + 4 * ring]), 0.0, 9.0, opaque=True))
    return hall(*houses)


def test_a_thousand_buildings_cost_little() -> None:
    place = town(1000)
    began = time.perf_counter()
    base = PhysicalBase(place)
    built = time.perf_counter()
    for seed in range(10):
        standing(base, Pose(20.0, 20.0, 0.0), seed)
    put = time.perf_counter()
    drive(base, "forward", 4.0)
    driven = time.perf_counter()
    # Measured: 0.15 s, 0.6 ms and 1.3 ms; the bounds leave room for a busy machine.
    assert built - began < 3.0
    assert (put - built) / 10 < 0.02
    assert (driven - put) / 40 < 0.01, "for a tenth of a second of driving"


@pytest.mark.parametrize("name", ["yard", "campus"])
def test_following_the_route_leads_to_the_victim_without_a_collision(name: str) -> None:
    world = load_world(name)
    simulation = Simulation(world, StubCamera(fraction=0.01), PhysicalBase(world.place))
    simulation.reset(11, "run")
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y)
    assert not simulation.collided
    assert simulation.look().victim_found
