"""Where the robot may be and go: collisions, routes to the victim, starts, and variations that leave the way free."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.place import World
from services.simulator.world.route import Obstacles, obstacles_of, plan_route
from services.simulator.world.task import sample_start
from services.simulator.world.varying import vary

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
    distances += [max(0.0, here.distance(shapely.Point(tree.x, tree.y)) - tree.trunk_radius_m) for tree in CAMPUS.trees]
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
    trunks = [shapely.Point(tree.x, tree.y).buffer(tree.trunk_radius_m) for tree in world.place.trees]
    walls = [building.footprint for building in world.place.buildings]
    return shapely.union_all([*trunks, *walls, *(barrier.line for barrier in world.place.barriers)])


@given(name=st.sampled_from(sorted(WORLDS)), seed=st.integers(0, 2**32 - 1), recovery=st.booleans())
@settings(max_examples=50)
def test_a_route_touches_nothing_and_ends_at_the_victim(name: str, seed: int, recovery: bool) -> None:
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
    assert (moved.start, moved.victim, moved.place.roads) == (world.start, world.victim, world.place.roads)  # type: ignore[attr-defined]
    pairs = zip(world.place.trees, moved.place.trees, strict=True)  # type: ignore[attr-defined]
    assert any(one != other for one, other in pairs)


SOLID = {name: solid(world) for name, world in WORLDS.items()}
