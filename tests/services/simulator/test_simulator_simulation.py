"""Without pixels: free places, routes, variations; episodes repeat, walls stop the robot."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.base import ATOMS, KEYS, TICK_S, Atom, Velocity
from schemas.rpc import ResetRequest
from services.simulator.base import KinematicBase
from services.simulator.lockstep import LockstepEpisode
from services.simulator.robots import DriveTrain
from services.simulator.simulation import Simulation
from services.simulator.variation import DAY, VARIATIONS
from services.simulator.world import load_world
from services.simulator.world.place import World
from services.simulator.world.route import Obstacles, obstacles_of, plan_route
from services.simulator.world.task import sample_start
from services.simulator.world.varying import vary
from tests.services.simulator.simulator_driving import StubCamera, drive_to

YARD = load_world("yard")
PERFECT = DriveTrain(tick_sigma=0.0, radius_sigma=0.0)


@given(
    seed=st.integers(0, 1000),
    purpose=st.sampled_from(["drive", "run", "recovery"]),
    atoms=st.lists(st.sampled_from(ATOMS), max_size=30),
)
@settings(max_examples=20)
def test_same_seed_gives_the_same_episode(seed: int, purpose: str, atoms: list[Atom]) -> None:
    whole, sliced = (Simulation(YARD, StubCamera()) for _ in range(2))
    assert whole.reset(seed, purpose) == sliced.reset(seed, purpose)
    for atom in atoms:
        whole.advance(KEYS[atom], 0.1)
        for _ in range(5):
            sliced.advance(KEYS[atom], 0.02)
    assert (whole.pose, whole.collided) == (sliced.pose, sliced.collided)
    one = whole.look()
    other = sliced.look()
    assert (one.odometry, one.imu) == (other.odometry, other.imu)


@pytest.mark.parametrize("physical", [False, True])
def test_kidnapped_robot_keeps_its_odometry(physical: bool) -> None:
    simulation, again = (
        Simulation(YARD, StubCamera(), None if physical else KinematicBase(YARD.place, PERFECT))
        for _ in range(2)
    )
    for one in (simulation, again):
        one.reset(5, "run")
        one.advance(KEYS["forward"], 0.5)
    before = simulation.pose
    wheels = simulation.look().odometry
    carried = simulation.carry_away()
    assert carried == simulation.pose == again.carry_away()
    assert math.hypot(carried.x - before.x, carried.y - before.y) > 1.0
    now = simulation.look().odometry
    assert now[:3] == wheels[:3]
    for one in (simulation, again):
        one.advance(KEYS["forward"], 0.2)
    assert simulation.pose == again.pose
    by_wheels = simulation.look().odometry
    moved = math.hypot(by_wheels.x_m - wheels.x_m, by_wheels.y_m - wheels.y_m)
    assert moved == pytest.approx(
        math.hypot(simulation.pose.x - carried.x, simulation.pose.y - carried.y), abs=0.1
    )
    assert moved > 0.1
    simulation.reset(5, "run")
    simulation.advance(KEYS["forward"], 0.5)
    assert simulation.pose == before, "the next episode is as if nobody had been carried"


@given(seed=st.integers(0, 500), atoms=st.lists(st.sampled_from(ATOMS), min_size=5, max_size=25))
@settings(max_examples=12)
def test_the_robot_never_enters_anything(seed: int, atoms: list[Atom]) -> None:
    simulation = Simulation(YARD, StubCamera())
    simulation.reset(seed, "recovery")
    for atom in atoms:
        simulation.advance(KEYS[atom], 0.4)
        assert (
            obstacles_of(YARD.place).clearance(simulation.pose.x, simulation.pose.y)
            > YARD.robot.radius_m - 1e-9
        )


def test_the_victim_is_found_only_when_near_and_seen() -> None:
    camera = StubCamera(fraction=0.5)
    simulation = Simulation(YARD, camera)
    simulation.reset(0, "run")
    assert not simulation.look().victim_found
    assert camera.asked == 0, "far away, the image is not searched at all"
    for x, y in simulation.route()[1:]:
        drive_to(simulation, x, y)
    assert simulation.look().victim_found
    camera.fraction = 0.0004
    assert not simulation.look().victim_found


def test_another_exposure_is_seen() -> None:
    fair, dark = (
        Simulation(YARD, StubCamera(), variation=variation).look().image.mean()
        for variation in (VARIATIONS["day"], VARIATIONS["dark"])
    )
    assert dark < 0.7 * fair


def test_noise_and_defocus_are_seen() -> None:
    step = np.zeros((24, 32, 3), dtype=np.uint8)
    step[:, 16:] = 200
    camera = StubCamera()
    camera.render = lambda _pose, _tilt: step  # type: ignore[method-assign]
    fair, noisy, blurred = (
        Simulation(YARD, camera, variation=replace(DAY, **fields)).look().image.astype(float)
        for fields in ({}, {"noise": 20.0}, {"defocus": 100.0})
    )
    assert fair[:, 24:].std() < 5 < noisy[:, 24:].std()
    assert np.abs(np.diff(blurred, axis=1)).max() < 0.5 * np.abs(np.diff(fair, axis=1)).max()


CAMPUS = load_world("campus").place
OBSTACLES = Obstacles(CAMPUS)
WORLDS = {name: load_world(name) for name in ("campus", "yard")}
worlds = st.sampled_from(sorted(WORLDS))
seeds = st.integers(0, 2**32 - 1)
other_days = st.integers(1, 10_000)


def brute_force(x: float, y: float) -> float:
    """Return the clearance by asking every single obstacle."""
    here = shapely.Point(x, y)
    if not here.within(shapely.box(*CAMPUS.bounds)):
        return 0.0
    distances = [here.distance(building.footprint) for building in CAMPUS.buildings]
    distances += [here.distance(barrier.line) for barrier in CAMPUS.barriers]
    distances += [here.distance(area.footprint) for area in CAMPUS.areas if area.kind == "water"]
    distances += [
        max(0.0, here.distance(shapely.Point(tree.x, tree.y)) - tree.trunk_radius_m)
        for tree in CAMPUS.trees
    ]
    x_min, y_min, x_max, y_max = CAMPUS.bounds
    return min([*distances, x - x_min, x_max - x, y - y_min, y_max - y])


@given(x=st.floats(-103, 103), y=st.floats(-103, 103))
@settings(max_examples=150)
def test_clearance_is_the_distance_to_the_nearest_thing(x: float, y: float) -> None:
    expected = brute_force(x, y)
    # Trunks are polygons of 32 sides inside their circle, up to a millimetre smaller.
    assert OBSTACLES.clearance(x, y) == pytest.approx(expected, abs=2e-3)
    if abs(expected - CAMPUS.robot.radius_m) > 2e-3:
        assert OBSTACLES.is_free(x, y) == (expected > CAMPUS.robot.radius_m)


def solid(world: World) -> shapely.Geometry:
    """Return everything solid, independently of `collision`."""
    trunks = [
        shapely.Point(tree.x, tree.y).buffer(tree.trunk_radius_m) for tree in world.place.trees
    ]
    walls = [building.footprint for building in world.place.buildings]
    return shapely.union_all([*trunks, *walls, *(barrier.line for barrier in world.place.barriers)])


@given(name=st.sampled_from(sorted(WORLDS)), seed=st.integers(0, 2**32 - 1), recovery=st.booleans())
@settings(max_examples=50)
def test_route_is_free_and_ends_at_the_victim(name: str, seed: int, recovery: bool) -> None:
    world = WORLDS[name]
    start = sample_start(world, np.random.default_rng(seed), "recovery" if recovery else "run")
    route = plan_route(world, (start.x, start.y))
    np.testing.assert_allclose(route[0], (start.x, start.y))
    np.testing.assert_allclose(route[-1], (world.victim.x, world.victim.y))
    assert shapely.LineString(route).distance(SOLID[name]) >= WORLDS[name].robot.radius_m


@given(name=worlds, seed=other_days)
@settings(max_examples=10)
def test_moved_things_leave_the_way_free(name: str, seed: int) -> None:
    world = WORLDS[name]
    moved = vary(world, clutter_seed=seed)
    route = plan_route(world, (world.start.x, world.start.y))
    legs = np.stack([route[:-1], route[1:]], axis=1)
    assert obstacles_of(moved.place).are_clear(legs, world.robot.radius_m).all()
    assert (moved.start, moved.victim, moved.place.roads) == (
        world.start,
        world.victim,
        world.place.roads,
    )
    pairs = zip(world.place.trees, moved.place.trees, strict=True)
    assert any(one != other for one, other in pairs)


SOLID = {name: solid(world) for name, world in WORLDS.items()}


def test_car_keeps_its_radius() -> None:
    simulation = Simulation(replace(YARD, drive=PERFECT.car), StubCamera())
    episode = LockstepEpisode(simulation, ResetRequest(seed=1))
    start = simulation.pose
    episode.step("left")
    assert simulation.pose == start
    episode.step(Velocity(0.5, 1.0))
    turned = math.remainder(simulation.pose.heading - start.heading, math.tau)
    chord_m = math.hypot(simulation.pose.x - start.x, simulation.pose.y - start.y)
    assert chord_m == pytest.approx(2.0 * 1.5 * math.sin(turned / 2.0))
    assert chord_m == pytest.approx(0.5 * PERFECT.speed_m_s * TICK_S, rel=0.01)
