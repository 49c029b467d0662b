"""What a map says with relations and tags, and what becomes of it: courtyards, parts, roofs, openings, trees."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from services.simulator.world import World, load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.outlines import OutlineError, area_of_rings
from services.simulator.world.terrain import Building, Terrain
from tests.services.simulator.map_text import MapText, block_of_houses, corners

SCRIBBLE = [(x, y) for x, y in np.random.default_rng(0).uniform(-50, 50, (400, 2)).tolist()]
SCRIBBLE.append(SCRIBBLE[0])


def terrain_of(made: MapText, folder: Path) -> Terrain:
    place = load_world(made.write(folder / "map.osm")).place
    assert isinstance(place, Terrain)
    return place


def at(terrain: Terrain, x: float, y: float) -> list[Building]:
    return [building for building in terrain.buildings if building.footprint.contains(shapely.Point(x, y))]


def can_drive(world: World, *path: tuple[float, float]) -> bool:
    legs = np.stack([np.array(path[:-1]), np.array(path[1:])], axis=1)
    return bool(obstacles_of(world.place).are_clear(legs, world.scale.clearance_m).all())


def test_a_relation_is_a_building_with_a_courtyard_drawn_once(tmp_path: Path) -> None:
    made = block_of_houses()
    west = made.way([(-20, -12), (-20, 12), (0, 12)])
    east = made.way([(0, 12), (20, 12), (20, -12), (-20, -12)], building="yes")
    court = made.box(0, 0, 20, 10, landuse="grass")
    made.multipolygon([west, east], [court], building="university", building__levels="4")
    terrain = terrain_of(made, tmp_path)
    (hall,) = at(terrain, -15, 0)
    assert hall.footprint.area == pytest.approx(40 * 24 - 20 * 10, rel=1e-3)
    assert len(hall.footprint.interiors) == 1
    assert hall.height_m == 12
    assert at(terrain, 0, 0) == []
    assert [area.kind for area in terrain.areas] == ["grass"], "the courtyard's own tags count"
    assert len(terrain.buildings) == 7
    source = terrain.source
    assert source is not None
    assert source.used["building relation"] == 1
    # The member way has a building tag of its own but is open: drawn with its relation, it is not broken either.
    assert terrain.skipped == 0
    assert source.left_out == {"building: drawn with its relation": 1}


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


@settings(max_examples=60, deadline=None)
@given(
    cuts=st.lists(st.integers(1, 39), min_size=1, max_size=6, unique=True),
    flips=st.lists(st.booleans(), min_size=8, max_size=8),
    order=st.randoms(use_true_random=False),
    hole=st.booleans(),
)
def test_rings_are_put_together_from_any_pieces(
    cuts: list[int], flips: list[bool], order: random.Random, hole: bool
) -> None:
    """However a ring is cut into ways, whichever way they run and come, the area is that of the ring."""
    angles = np.linspace(0, 2 * np.pi, 41)
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) * (30 + 5 * np.cos(3 * angles))[:, None]
    ring[-1] = ring[0]
    ends = [0, *sorted(cuts), 40]
    pieces = [ring[first : last + 1] for first, last in itertools.pairwise(ends)]
    lines = [shapely.LineString(piece[::-1] if flip else piece) for piece, flip in zip(pieces, flips, strict=False)]
    order.shuffle(lines)
    holes = [shapely.LineString(corners(0, 0, 8, 6))] if hole else []
    expected = Polygon(ring).area - (48 if hole else 0)
    assert area_of_rings(lines, holes).area == pytest.approx(expected)
    # Where roles were forgotten, a ring inside another is a hole all the same.
    assert area_of_rings([*lines, *holes], []).area == pytest.approx(expected)
    with pytest.raises(OutlineError):
        area_of_rings(lines[1:], holes)


def test_parts_are_drawn_instead_of_a_building_that_they_cover(tmp_path: Path) -> None:
    made = block_of_houses()
    made.box(0, 0, 40, 20, building="church", building__material="brick", height="8")
    made.box(-12, 0, 16, 20, building__part="yes", height="40", min_height="2")
    made.box(8, 0, 24, 20, building__part="yes", building__levels="2")
    made.box(-30, 0, 4, 4, building__part="yes")
    terrain = terrain_of(made, tmp_path)
    (tower,), (nave,) = at(terrain, -12, 0), at(terrain, 8, 0)
    assert (tower.height_m, tower.min_height_m, nave.height_m) == (40, 2, 6)
    assert tower.facade == nave.facade
    assert tower.facade.style == "brick"
    assert terrain.source is not None
    assert terrain.source.used["building part"] == 2
    assert terrain.source.left_out == {"building part: it is in no building": 1}


def test_the_robot_drives_under_a_building_where_a_passage_leads_through(tmp_path: Path) -> None:
    made = block_of_houses()
    made.way([(0, -60), (0, -10), (0, 10), (0, 30)], highway="service", tunnel="building_passage")
    made.box(0, 0, 40, 20, building="apartments", building__levels="4", roof__shape="hipped")
    world = load_world(made.write(tmp_path / "map.osm"))
    assert isinstance(world.place, Terrain)
    (above,) = at(world.place, 0, 0)
    assert (above.min_height_m, above.height_m) == (3.2, 12)
    assert can_drive(world, (0, -20), (0, 20))
    assert not can_drive(world, (15, -20), (15, 20))
    pieces = [
        building.footprint for building in world.place.buildings if building.footprint.distance(above.footprint) < 1
    ]
    assert sum(piece.area for piece in pieces) == pytest.approx(800, rel=1e-3), "nothing of the building is lost"


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


def test_woods_and_rows_grow_trees_that_stand_in_nobodys_way(tmp_path: Path) -> None:
    made = block_of_houses()
    made.box(0, 0, 100, 60, natural="wood", leaf_type="needleleaved")
    made.way([(0, -60), (0, 60)], highway="footway")
    made.way([(-90, 75), (-10, 75)], natural="tree_row")
    terrain = terrain_of(made, tmp_path)
    assert len([tree for tree in terrain.trees if tree.y > 74]) == 10
    wood = [tree for tree in terrain.trees if tree.y < 74]
    assert 40 <= len(wood) <= 120
    assert {tree.kind for tree in wood} == {"conifer"}
    roads = shapely.union_all([road.line.buffer(road.width_m / 2) for road in terrain.roads])
    walls = shapely.union_all([building.footprint for building in terrain.buildings])
    for tree in wood:
        assert roads.distance(shapely.Point(tree.x, tree.y)) > 1.3 + tree.trunk_radius_m - 0.1
        assert walls.distance(shapely.Point(tree.x, tree.y)) > 1
    assert terrain_of(made, tmp_path).trees == terrain.trees
