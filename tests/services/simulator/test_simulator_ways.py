"""Where the robot may be and go: collisions, routes to the victim, starts, and variations that leave the way free."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.collision import Obstacles, obstacles_of
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.room import sights
from services.simulator.world.route import plan_route
from services.simulator.world.task import sample_start
from services.simulator.world.terrain import Building, Facade, Terrain, plan
from services.simulator.world.varying import vary

CAMPUS = load_world("campus").place
OBSTACLES = Obstacles(CAMPUS)
WORLDS = {name: load_world(name) for name in ("campus", "yard")}
ROAD_POINTS = np.concatenate([shapely.get_coordinates(road.line) for road in WORLDS["campus"].place.roads])
worlds = st.sampled_from(sorted(WORLDS))
seeds = st.integers(0, 2**32 - 1)
INDOOR = load_world("indoor")
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
@settings(max_examples=300, deadline=None)
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
@settings(max_examples=150, deadline=None)
def test_a_route_touches_nothing_and_ends_at_the_victim(name: str, seed: int, recovery: bool) -> None:
    world = WORLDS[name]
    start = sample_start(world, np.random.default_rng(seed), "recovery" if recovery else "run")
    route = plan_route(world, (start.x, start.y))
    np.testing.assert_allclose(route[0], (start.x, start.y))
    np.testing.assert_allclose(route[-1], (world.victim.x, world.victim.y))
    assert shapely.LineString(route).distance(SOLID[name]) >= WORLDS[name].robot.radius_m


@given(x=st.floats(-99, 99), y=st.floats(-99, 99))
@example(x=5e-324, y=5e-324)
@settings(max_examples=200, deadline=None)
def test_from_anywhere_the_way_is_free_or_missing_but_never_through_a_wall(x: float, y: float) -> None:
    try:
        route = plan_route(WORLDS["campus"], (x, y))
    except WorldError:
        # Cut off are the insides of things, their edges, and corners that see no road within 40 m.
        seen = obstacles_of(WORLDS["campus"].place).are_clear(
            np.array([[(x, y), point] for point in ROAD_POINTS if np.hypot(*(point - (x, y))) < 40]).reshape(-1, 2, 2),
            0.7,
        )
        assert not seen.any()
    else:
        assert not shapely.LineString(route).intersects(SOLID["campus"])


@given(name=worlds, seed=seeds)
@settings(max_examples=200, deadline=None)
def test_a_run_starts_about_the_start_with_the_victim_out_of_sight(name: str, seed: int) -> None:
    world = WORLDS[name]
    pose = sample_start(world, np.random.default_rng(seed), "run")
    assert max(abs(pose.x - world.start.x), abs(pose.y - world.start.y)) <= 1.0
    assert abs(math.remainder(pose.heading - world.start.heading, math.tau)) <= math.radians(15) + 1e-9
    # A person lies half a metre to either side of the victim's place.
    sights = np.array([
        [(pose.x, pose.y), (world.victim.x + 0.9 * math.cos(turn), world.victim.y + 0.9 * math.sin(turn))]
        for turn in (world.victim.heading, world.victim.heading + math.pi)
    ])  # fmt: skip
    assert not obstacles_of(world.place).in_sight(sights).any()


@given(name=worlds, seed=seeds)
@settings(max_examples=200, deadline=None)
def test_a_recovery_starts_beside_the_route(name: str, seed: int) -> None:
    world = WORLDS[name]
    pose = sample_start(world, np.random.default_rng(seed), "recovery")
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    here = shapely.Point(pose.x, pose.y)
    assert here.distance(route) <= 1.5 + 1e-6
    assert here.distance(shapely.Point(world.victim.x, world.victim.y)) >= 1.5
    assert obstacles_of(world.place).is_free(pose.x, pose.y, world.robot.radius_m)


def test_a_start_without_room_is_an_error_and_not_an_endless_search() -> None:
    world = WORLDS["campus"]
    terrain = cast("Terrain", world.place)
    around = shapely.Point(world.start.x, world.start.y).buffer(3)
    block = Building(**plan(around), height_m=5.0, facade=Facade("brick"))
    blocked = replace(world, place=replace(terrain, buildings=(*terrain.buildings, block)))
    with pytest.raises(WorldError, match="no free start pose"):
        sample_start(blocked, np.random.default_rng(0), "run")
    assert isinstance(blocked.start, Pose)


@given(name=worlds, seed=other_days)
@settings(max_examples=25, deadline=None)
def test_moved_things_leave_the_way_free(name: str, seed: int) -> None:
    world = WORLDS[name]
    moved = vary(world, clutter_seed=seed)
    route = plan_route(world, (world.start.x, world.start.y))
    legs = np.stack([route[:-1], route[1:]], axis=1)
    assert obstacles_of(moved.place).are_clear(legs, world.robot.radius_m).all()
    assert (moved.start, moved.victim, moved.place.roads) == (world.start, world.victim, world.place.roads)  # type: ignore[attr-defined]
    pairs = list(zip(world.place.trees, moved.place.trees, strict=True))  # type: ignore[attr-defined]
    away = np.array([np.hypot(one.x - other.x, one.y - other.y) for one, other in pairs])
    assert away.max() <= 3 * np.sqrt(2)
    assert (away > 0.1).mean() > 0.5, "most of them do move"
    solid = shapely.union_all([building.footprint for building in world.place.buildings])  # type: ignore[attr-defined]
    for (_, tree), way in zip(pairs, away, strict=True):
        assert way == 0 or shapely.Point(tree.x, tree.y).distance(solid) > tree.trunk_radius_m * 0.99


@given(seed=other_days)
@settings(max_examples=15, deadline=None)
def test_furniture_that_was_pushed_about_stands_in_the_room_and_in_nothing_else(seed: int) -> None:
    before, after = INDOOR, vary(INDOOR, clutter_seed=seed)
    route = plan_route(before, (before.start.x, before.start.y))
    legs = np.stack([route[:-1], route[1:]], axis=1)
    assert obstacles_of(after.place).are_clear(legs, before.scale.clearance_m).all()
    pieces = after.place.furniture  # type: ignore[attr-defined]
    area = shapely.union_all([piece.footprint for piece in pieces]).area
    assert area == pytest.approx(sum(piece.footprint.area for piece in pieces))
    assert all(shapely.box(*after.place.bounds).buffer(1e-6).covers(piece.footprint) for piece in pieces)
    pairs = list(zip(before.place.furniture, pieces, strict=True))  # type: ignore[attr-defined]
    assert sum(one != other for one, other in pairs) >= 3
    assert all(math.hypot(one.x_m - other.x_m, one.y_m - other.y_m) <= 0.3 * math.sqrt(2) for one, other in pairs)
    assert not obstacles_of(after.place).in_sight(sights(after)).any(), "the victim stays hidden"


SOLID = {name: solid(world) for name, world in WORLDS.items()}
