"""Obstacles after teaching: beside the way, or across it."""

import math

import numpy as np
import pytest
import shapely
from scipy.ndimage import label

from schemas.base import KEYS, STANDING
from schemas.rpc import ResetRequest
from services.expert.driver import RouteDriver
from services.kit.node import ServiceError
from services.simulator.base import KinematicBase
from services.simulator.body import SimulatedBody
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import Obstacles
from tests.services.simulator.simulator_driving import StubCamera

WORLDS = {name: load_world(name) for name in ("campus", "indoor")}


class Shown(StubCamera):
    """A camera that remembers the obstacles to show."""

    def obstruct(self, things: tuple[object, ...]) -> None:
        self.things = things


def simulated(world: str) -> Simulation:
    there = WORLDS[world]
    return Simulation(there, Shown(), KinematicBase(there.place))


def passes(simulation: Simulation, room: float) -> bool:
    """Whether a disc of this many robot radii passes along the way."""
    radius_m = simulation.world.robot.radius_m
    way = shapely.LineString(simulation.route())
    corridor = way.buffer(5 * radius_m)
    solids = [solid for thing in simulation.obstacles for solid in thing.solids]
    there = Obstacles(simulation.world.place, solids)
    x, y = (
        np.arange(low, high, radius_m / 3) for low, high in np.reshape(corridor.bounds, (2, 2)).T
    )
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    inside = shapely.contains_xy(corridor, grid[..., 0], grid[..., 1])
    free = np.zeros(inside.shape, dtype=bool)
    free[inside] = [there.is_free(*place, room * radius_m) for place in grid[inside].tolist()]
    parts, _ = label(free, np.ones((3, 3)))
    along = shapely.line_locate_point(way, shapely.points(grid))
    first, last = (
        set(parts[free & near]) for near in (along < 0.1 * way.length, along > 0.9 * way.length)
    )
    return bool(first & last)


@pytest.mark.parametrize("world", WORLDS)
def test_obstacles_stand_in_the_way_and_leave_room(world: str) -> None:
    simulation = simulated(world)
    for seed in (1, 2):
        simulation.reset(seed, "run", obstacles=3)
        assert simulation._seen[1].things == simulation.obstacles
        assert len(simulation.obstacles) == 3
        assert passes(
            simulation, 1.8 if world == "campus" else 1.3
        )  # indoors the way itself is narrower than that
        same = simulation.obstacles
        simulation.reset(seed, "run", obstacles=3)
        assert simulation.obstacles == same
    driver = RouteDriver(simulation.route().tolist(), simulation.speed_m_s, simulation.found_m)
    for _ in range(1500):
        pose = simulation.pose
        simulation.advance(KEYS[driver.key(pose.x, pose.y, pose.heading)], 0.1)
        if simulation.collided or driver.arrived(pose.x, pose.y):
            break
    assert simulation.collided
    simulation.reset(2, "run")
    assert simulation.obstacles == ()


@pytest.mark.parametrize("world", WORLDS)
def test_blocked_way_has_no_passage(world: str) -> None:
    simulation = simulated(world)
    simulation.reset(1, "run")
    assert passes(simulation, 1.0)
    simulation.reset(1, "run", blocked=True)
    assert not passes(simulation, 1.0)


@pytest.mark.parametrize("world", WORLDS)
def test_people_walk_wait_and_are_hit_by_blind_robots(
    world: str,
) -> None:
    simulation = simulated(world)
    simulation.reset(1, "run", people=3)
    first = simulation.people[0]
    passed = [simulation.people[0].pose]
    for _ in range(300):
        simulation.advance(STANDING, 0.1)
        passed.append(first.pose)
    away = [math.hypot(one.x - passed[0].x, one.y - passed[0].y) for one in passed]
    assert max(away) > 0.8

    def stand(at: Pose, ticks: int) -> float:
        simulation.reset(1, "run", people=3)
        simulation._base.put(at, np.random.default_rng(0))
        nearest = math.inf
        for _ in range(ticks):
            simulation.advance(STANDING, 0.1)
            here = simulation.people[0].pose
            nearest = min(nearest, math.hypot(here.x - at.x, here.y - at.y))
        return nearest

    radius_m = simulation.world.robot.radius_m
    assert stand(passed[int(np.argmax(away))], 300) < radius_m + 0.8
    assert not simulation.collided
    stand(passed[0], 1)
    assert simulation.collided


def test_a_way_too_short_for_so_many_says_so() -> None:
    body = SimulatedBody(simulated("indoor"))
    with pytest.raises(ServiceError, match=r"room for . of 50 obstacles"):
        body.begin(ResetRequest(seed=1, obstacles=50))


def test_clearance_counts_walls_obstacles_and_people() -> None:
    simulation = simulated("campus")
    simulation.reset(1, "run")
    radius_m = simulation.world.robot.radius_m
    there = simulation.world.place
    walls_m = Obstacles(there).clearance(simulation.pose.x, simulation.pose.y) - radius_m
    assert simulation.clearance_m == pytest.approx(walls_m)
    simulation.reset(1, "run", obstacles=3)
    middle = simulation.obstacles[0].footprint.centroid
    beside = simulation.obstacles[0].footprint.bounds[2] + radius_m + 0.1
    simulation.pose = Pose(middle.x, middle.y, 0.0)
    assert simulation.clearance_m == 0.0
    simulation.pose = Pose(beside, middle.y, 0.0)
    assert 0.0 < simulation.clearance_m < 0.3
    simulation.reset(1, "run", people=1)
    (person,) = simulation.people
    simulation.pose = Pose(person.pose.x + radius_m + 0.25 + 0.05, person.pose.y, 0.0)
    assert simulation.clearance_m == pytest.approx(0.05)
