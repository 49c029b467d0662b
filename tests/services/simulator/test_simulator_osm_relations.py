"""What a map says with relations and tags, and what becomes of it: courtyards, parts, roofs, openings, trees."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services.simulator.world import World, load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.terrain import Terrain
from tests.services.simulator.map_text import MapText, block_of_houses

SCRIBBLE = [(x, y) for x, y in np.random.default_rng(0).uniform(-50, 50, (400, 2)).tolist()]
SCRIBBLE.append(SCRIBBLE[0])


def terrain_of(made: MapText, folder: Path) -> Terrain:
    place = load_world(made.write(folder / "map.osm")).place
    assert isinstance(place, Terrain)
    return place


def can_drive(world: World, *path: tuple[float, float]) -> bool:
    legs = np.stack([np.array(path[:-1]), np.array(path[1:])], axis=1)
    return bool(obstacles_of(world.place).are_clear(legs, world.scale.clearance_m).all())


@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (lambda made: made.multipolygon([made.way([(0, 0), (9, 0), (9, 9)])], building="yes"),
         "its rings do not close or cross each other"),
        (lambda made: made.multipolygon([made.box(0, 0, 9, 9), 999_999], building="yes"),
         "a member of it is not in the file"),
        (lambda made: made.relation([("relation", 999, "outer")], type="multipolygon", building="yes"),
         "its outline is not closed"),
        (lambda made: made.multipolygon([made.way([(0, 0)])], building="yes"), "a member of it is broken"),
        (lambda made: made.raw('<relation id="7777" version="1"><member type="relation" ref="7777" role="outer"/>'
                               '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation>'),
         "its outline is not closed"),
        (lambda made: made.way([(0, 0)], building="yes"), "it has fewer than two points"),
        (lambda made: made.way([(0, 0), (9, 0), (9, 9)], building="yes"), "its outline is not closed"),
        (lambda made: made.way([(0, 0), (9, 0), (0, 0), (9, 0), (0, 0)], building="yes"),
         "its outline encloses nothing"),
        (lambda made: made.box(0, 0, 1, 1, building="yes"), "it is smaller than 4 m2"),
        (lambda made: made.node((0.0, 0.0), building="yes"), "it is a point without an outline"),
        (lambda made: made.way(SCRIBBLE, building="yes"), "it crosses itself too often"),
    ],
)  # fmt: skip
def test_what_is_broken_is_left_out_and_counted_by_reason(
    break_it: Callable[[MapText], object], reason: str, tmp_path: Path
) -> None:
    made = block_of_houses()
    break_it(made)
    terrain = terrain_of(made, tmp_path)
    assert terrain.source is not None
    assert terrain.source.skipped == {f"building: {reason}": 1}
    assert terrain.skipped == 1
    assert len(terrain.buildings) == 6


def test_roads_bridge_water_and_open_walls_and_gates(tmp_path: Path) -> None:
    made = block_of_houses()
    made.way([(-90, 0), (90, 0)], waterway="river", width="10")
    made.way([(-50, 25), (-20, 25), (50, 25)], barrier="wall")
    made.node((-20.0, 25.0), barrier="gate")
    made.way([(20, -60), (20, 60)], highway="footway", bridge="yes")
    world = load_world(made.write(tmp_path / "map.osm"))
    assert can_drive(world, (20, -20), (20, 33))
    assert can_drive(world, (-60, -20), (-60, 20)), "a street over the river"
    assert not can_drive(world, (0, -20), (0, 20)), "beside the bridge is water"
    assert can_drive(world, (-20, 10), (-20, 33)), "through the gate"
    assert not can_drive(world, (0, 10), (0, 33)), "the wall beside it"
