"""Variations: each changes what it says and nothing else, and the way to the victim stays free."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.room import sights
from services.simulator.world.route import plan_route
from services.simulator.world.varying import vary

WORLDS = {name: load_world(name) for name in ("campus", "yard")}
INDOOR = load_world("indoor")
seeds = st.integers(1, 10_000)


@given(name=st.sampled_from(sorted(WORLDS)), seed=seeds)
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


@given(seed=seeds)
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
