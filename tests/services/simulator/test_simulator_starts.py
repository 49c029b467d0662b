"""Start poses: seeded, where they should be, and never in sight of the victim."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import Pose, WorldError
from services.simulator.world.route import plan_route
from services.simulator.world.task import sample_start
from services.simulator.world.terrain import Building, Facade, Terrain, plan

WORLDS = {name: load_world(name) for name in ("campus", "yard")}
worlds = st.sampled_from(sorted(WORLDS))
seeds = st.integers(0, 2**32 - 1)


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
