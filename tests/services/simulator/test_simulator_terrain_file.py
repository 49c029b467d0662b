"""World files: what is written is read again, what a person changes counts, what is hostile is one clear line."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from services.simulator.world import Pose, World, WorldError, load_world
from services.simulator.world.importing import import_map
from services.simulator.world.loading import WORLDS_FOLDER, Wishes
from services.simulator.world.route import lane_graph
from services.simulator.world.terrain import Area, Barrier, Building, Facade, Road, Source, Terrain, Tree
from services.simulator.world.terrain_file import read_terrain, terrain_text
from tests.services.simulator.map_text import block_of_houses, corners

HERE = Path("here.json")


def read(text: str) -> World:
    return read_terrain(json.loads(text), HERE)


def said(world: World) -> tuple[object, ...]:
    """Return everything that a world is, in values that can be compared."""
    place = world.place
    assert isinstance(place, Terrain)
    return (
        place.bounds, place.skipped, place.source, world.start, world.victim, place.trees,
        [(b.footprint.wkt, b.height_m, b.facade, b.roof, b.min_height_m, b.roof_height_m, b.roof_colour)
         for b in place.buildings],
        [(r.line.wkt, r.width_m, r.kind, r.drivable, r.marked, r.sidewalks) for r in place.roads],
        [(a.polygon.wkt, a.kind) for a in place.areas],
        [(b.line.wkt, b.height_m, b.kind) for b in place.barriers],
    )  # fmt: skip


COORDINATE = st.floats(-900, 900)
BYTE = st.integers(0, 255)
COLOUR = st.none() | st.tuples(BYTE, BYTE, BYTE)
POSE = st.builds(Pose, COORDINATE, COORDINATE, st.floats(-3.14, 3.14))
FOOTPRINT = st.builds(
    lambda x, y, width, depth, hole: shapely.Polygon(
        corners(x, y, width, depth), [corners(x, y, width / 2, depth / 2)] if hole else []
    ),
    COORDINATE, COORDINATE, st.floats(1, 90), st.floats(1, 90), st.booleans(),
)  # fmt: skip
LINE = st.builds(
    lambda x, y, dx, dy: shapely.LineString([(x, y), (x + dx, y), (x + dx, y + dy)]),
    COORDINATE, COORDINATE, st.floats(0.1, 90), st.floats(0.1, 90),
)  # fmt: skip
HEIGHT = st.floats(2.5, 300)
FACADE = st.builds(Facade, st.sampled_from(["brick", "glass"]), COLOUR, st.integers(0, 996))
TERRAIN = st.builds(
    Terrain,
    name=st.just("here"),
    bounds=st.just((-1000.0, -1000.0, 1000.0, 1000.0)),
    buildings=st.lists(
        st.builds(Building, FOOTPRINT, HEIGHT, FACADE, st.sampled_from(["flat", "gabled", "hipped"]),
                  st.floats(0, 2), st.floats(0, 9), COLOUR), max_size=4).map(tuple),
    roads=st.lists(
        st.builds(Road, LINE, st.floats(0.2, 40), st.sampled_from(["street", "path"]), st.booleans(), st.booleans(),
                  st.booleans()), max_size=4).map(tuple),
    areas=st.lists(st.builds(Area, FOOTPRINT, st.sampled_from(["grass", "water", "paved"])), max_size=3).map(tuple),
    trees=st.lists(
        st.builds(Tree, COORDINATE, COORDINATE, HEIGHT.map(lambda h: h / 10), st.sampled_from(["round", "conifer"])),
        max_size=3).map(tuple),
    barriers=st.lists(
        st.builds(Barrier, LINE, st.floats(0.3, 20), st.sampled_from(["hedge", "wall", "fence"])), max_size=3
    ).map(tuple),
    skipped=st.just(3),
    source=st.just(Source("a.osm", "© OpenStreetMap contributors", 41.5, -71.25, {"road": 2}, {"x: y": 3}, {})),
)  # fmt: skip


@settings(max_examples=80, deadline=None)
@given(terrain=TERRAIN, start=POSE, victim=POSE)
def test_a_world_that_is_written_and_read_is_the_same_to_the_millimetre(
    terrain: Terrain, start: Pose, victim: Pose
) -> None:
    world = World(terrain, start, victim)
    text = terrain_text(world)
    again = read(text)
    assert said(read(terrain_text(again))) == said(again)
    assert terrain_text(again) == text
    place = again.place
    assert isinstance(place, Terrain)
    assert (place.name, place.bounds, place.source) == (terrain.name, terrain.bounds, terrain.source)
    assert (again.start.x, again.start.heading) == pytest.approx((start.x, start.heading), abs=1e-3)
    assert [b.facade for b in place.buildings] == [b.facade for b in terrain.buildings]
    for mine, theirs in zip(place.buildings, terrain.buildings, strict=True):
        assert mine.footprint.hausdorff_distance(theirs.footprint) < 0.001
        assert len(mine.footprint.interiors) == len(theirs.footprint.interiors)
        assert (mine.height_m, mine.min_height_m) == pytest.approx((theirs.height_m, theirs.min_height_m), abs=1e-3)


@pytest.mark.parametrize("name", ["campus", "yard"])
def test_our_worlds_survive_being_imported(name: str, tmp_path: Path) -> None:
    world = load_world(name)
    out = tmp_path / f"{name}.json"
    imported, text = import_map(WORLDS_FOLDER / f"{name}.osm", out, Wishes())
    out.write_text(text)
    assert said(load_world(out)) == said(imported)
    assert (imported.start.x, imported.victim.y) == pytest.approx((world.start.x, world.victim.y), abs=1e-3)
    mine, theirs = imported.place, world.place
    assert isinstance(mine, Terrain)
    assert isinstance(theirs, Terrain)
    assert len(mine.trees) == len(theirs.trees)
    assert [b.facade for b in mine.buildings] == [b.facade for b in theirs.buildings]
    assert len(mine.lanes) == len(theirs.lanes)


def test_only_what_is_connected_to_the_start_stays_drivable(tmp_path: Path) -> None:
    made = block_of_houses()
    made.way([(-90, 90), (90, 90)], highway="footway")
    source = made.write(tmp_path / "map.osm")
    everything = load_world(source)
    imported, _ = import_map(source, tmp_path / "out.json", Wishes())
    assert len(everything.place.lanes) == 2
    assert len(imported.place.lanes) == 1
    assert len(lane_graph(imported.place).points) < len(lane_graph(everything.place).points)


def world_file(change: Callable[[dict[str, Any]], object], folder: Path) -> Path:
    source = block_of_houses().write(folder / "map.osm")
    _, text = import_map(source, folder / "map.json", Wishes())
    content = json.loads(text)
    change(content)
    path = folder / "changed.json"
    path.write_text(json.dumps(content))
    return path


def test_a_person_moves_the_victim_in_the_file(tmp_path: Path) -> None:
    path = world_file(lambda content: content["victim"].update(x=-50, y=0), tmp_path)
    assert load_world(path).victim.x == -50


NAN = float("nan")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: c["victim"].update(x=0, y=40), r"the victim at \(0.0, 40.0\) m stands in an obstacle"),
        (lambda c: c["start"].update(x=99.9), "the start at .* stands in an obstacle or outside"),
        (lambda c: c["victim"].update(x=5000), "the victim at .* outside the world"),
        (lambda c: c["victim"].update(x="5"), "victim.x: Input should be a valid number"),
        (lambda c: c["victim"].update(x=NAN), "NaN is no number of JSON"),
        (lambda c: c["victim"].update(x=1e300), "victim.x: Input should be less than"),
        (lambda c: c["victim"].pop("x"), "victim.x: Field required"),
        (lambda c: c["victim"].update(z=0), "victim.z: Extra inputs are not permitted"),
        (lambda c: c.update(format="smal.terrain/2"), "its format is 'smal.terrain/2'; known are smal.terrain/1"),
        (lambda c: c.pop("format"), "its format is missing; known are"),
        (lambda c: c.update(buildings=[]), "the map has no buildings"),
        (lambda c: c.update(roads=[]), "the map has no roads"),
        (lambda c: [road.update(drivable=False) for road in c["roads"]], "no road that a robot could drive on"),
        (lambda c: c["buildings"][1].update(height_m=-1), r"buildings.1.height_m: Input should be greater than 0"),
        (lambda c: c["buildings"][1].update(min_height_m=50), "buildings.1.min_height_m: 50.* is not below"),
        (lambda c: c["buildings"][1].update(outline=[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]),
         "buildings.1: its outline crosses itself"),
        (lambda c: c["buildings"][1]["outline"].pop(), "buildings.1: a ring does not end where it begins"),
        (lambda c: c["buildings"][1]["facade"].update(style="gold"), "buildings.1.facade.style: Input should be"),
        (lambda c: c["roads"][0].update(line=[[1, 1], [1, 1]]), "roads.0.line: it has no length"),
        (lambda c: c["roads"][0].update(line=[[1, 1]]), "roads.0.line: List should have at least 2 items"),
        (lambda c: c.update(bounds=[1, 1, 0, 0]), "bounds: expected x_min, y_min, x_max, y_max"),
        (lambda c: c.update(bounds=[-9000, -9000, 9000, 9000]), "bounds: a world spans at most 10 km"),
        (lambda c: c["roads"][0].update(line=[[-4000, 0], [4000, 0]] * 100), "roads: .* km; a world has at most"),
        (lambda c: c.update(trees=[{}] * 60_000), "trees: List should have at most 50000 items"),
        (lambda c: c.update(trees=[[]] * 1_600_000), "more than 1,500,000 of"),
    ],
)  # fmt: skip
def test_a_bad_world_file_gives_one_line(
    change: Callable[[dict[str, Any]], object], complaint: str, tmp_path: Path
) -> None:
    path = world_file(change, tmp_path)
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "not a readable world file"),
        (b"[1]", "holds no JSON object"),
        (b"\xff\xfe{}", "not a readable world file"),
        (b'{"format": ' + b"[" * 200_000, "nested too deeply"),
        (b'{"format": ' + b"9" * 10_000 + b"}", "not a readable world file"),
        (b'{"format": "\\u001b[2J"}', r"its format is '\?\[2J'|its format is"),
        (b'{"format": "smal.terrain/1", "bounds": [1e999, 0, 1, 1]}', "bounds"),
    ],
    ids=range(7),
)
def test_a_file_that_is_no_world_is_refused_quickly(content: bytes, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    began_s = time.process_time()
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert time.process_time() - began_s < 2
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()


def test_a_file_of_a_gigabyte_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(WorldError, match="1074 MB; a world has at most 34 MB"):
        load_world(path)
