"""Maps and world files: valid ones load, broken objects are counted, hostile files are one clear line."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.simulator.world import World, WorldError, load_world, osm
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from services.simulator.world.route import obstacles_of, plan_route, route_length_m
from services.simulator.world.terrain import terrain_text
from tests.services.simulator.map_text import MapText, block_of_houses

BROWN = Path(__file__).parents[4] / "shared" / "data" / "osm" / "brown_university_campus.osm"
CAMPUS = (WORLDS_FOLDER / "campus.osm").read_text()
BILLION_LAUGHS = (
    '<!DOCTYPE osm [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    + ']><osm version="0.6"><node id="1" version="1" lat="1" lon="1"><tag k="name" v="&a9;"/></node></osm>'
)
POINT = '<node id="1" version="1" lat="1" lon="1"/>'
WAYS = "".join(
    f'<way id="{k}" version="1">' + '<nd ref="1"/>' * 2000 + "</way>" for k in range(1, 7)
)
SCRIBBLE = [(x, y) for x, y in np.random.default_rng(0).uniform(-50, 50, (400, 2)).tolist()]
SCRIBBLE.append(SCRIBBLE[0])
NAN = float("nan")
Change = Callable[[dict[str, Any]], object]


def can_drive(world: World, *path: tuple[float, float]) -> bool:
    legs = np.stack([np.array(path[:-1]), np.array(path[1:])], axis=1)
    return bool(obstacles_of(world.place).are_clear(legs, world.scale.clearance_m).all())


@pytest.mark.skipif(not BROWN.exists(), reason=f"the real extract is not on this machine: {BROWN}")
def test_a_real_extract_gets_a_hidden_victim_by_rule() -> None:
    world = load_world(BROWN)
    again = load_world(BROWN)
    assert len(world.place.buildings) > 350
    assert len(world.place.trees) == 32
    assert (world.start, world.victim) == (again.start, again.victim)
    sight = np.array([[(world.start.x, world.start.y), (world.victim.x, world.victim.y)]])
    assert not obstacles_of(world.place).in_sight(sight)[0]
    assert 55 <= route_length_m(plan_route(world, (world.start.x, world.start.y))) <= 150


@pytest.mark.parametrize("name", ["campus", "terrace", "yard"])
def test_a_world_that_is_imported_is_the_same_in_its_file(name: str, tmp_path: Path) -> None:
    out = tmp_path / f"{name}.json"
    imported, text = import_map(WORLDS_FOLDER / f"{name}.osm", out, Wishes())
    out.write_text(text)
    assert terrain_text(load_world(out)) == terrain_text(imported) == text
    world = load_world(name)
    assert (imported.start.x, imported.victim.y) == pytest.approx(
        (world.start.x, world.victim.y), abs=1e-3
    )


@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (lambda made: made.multipolygon([made.way([(0, 0), (9, 0), (9, 9)])], building="yes"),
         "its rings do not close or cross each other"),
        (lambda made: made.multipolygon([made.box(0, 0, 9, 9), 999_999], building="yes"),
         "a member is not in the file"),
        (lambda made: made.relation([("relation", 999, "outer")], type="multipolygon", building="yes"),
         "its outline is not closed"),
        (lambda made: made.multipolygon([made.way([(0, 0)])], building="yes"), "a member is invalid"),
        (lambda made: made.way([(0, 0)], building="yes"), "it has fewer than two points"),
        (lambda made: made.way([(0, 0), (9, 0), (9, 9)], building="yes"), "its outline is not closed"),
        (lambda made: made.way([(0, 0), (9, 0), (0, 0), (9, 0), (0, 0)], building="yes"),
         "its outline has no area"),
        (lambda made: made.box(0, 0, 1, 1, building="yes"), "it is smaller than 4 m2"),
        (lambda made: made.node((0.0, 0.0), building="yes"), "it is a point without an outline"),
        (lambda made: made.way(SCRIBBLE, building="yes"), "it crosses itself too often"),
    ],
)  # fmt: skip
def test_broken_map_objects_are_counted_by_reason(
    break_it: Callable[[MapText], object], reason: str, tmp_path: Path
) -> None:
    made = block_of_houses()
    break_it(made)
    terrain: Any = load_world(made.write(tmp_path / "map.osm")).place
    assert terrain.source.skipped == {f"building: {reason}": 1}
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


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Give the content of the world file of a block of houses."""
    folder = tmp_path_factory.mktemp("block")
    return import_map(block_of_houses().write(folder / "map.osm"), folder / "map.json", Wishes())[1]


def check_refused(path: Path, complaint: str) -> None:
    """Check that a file is refused within 2 s by one clear line that names it."""
    began_s = time.process_time()
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert time.process_time() - began_s < 2
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: c["victim"].update(x=0, y=40), r"the victim at \(0.0, 40.0\) m stands in an obstacle"),
        (lambda c: c["victim"].update(x=NAN), "victim.x: nan must be a finite number"),
        (lambda c: c.update(format="smal.terrain/2"), "tag 'smal.terrain/2' found using 'format' does not match"),
        (lambda c: c.update(buildings=[]), "the map has no buildings"),
        (lambda c: c["buildings"][1].update(outline=[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]),
         "buildings.1: its outline crosses itself"),
        (lambda c: c.update(bounds=[1, 1, 0, 0]), "bounds: expected x_min, y_min, x_max, y_max"),
        (lambda c: c.update(bounds=[-9000, -9000, 9000, 9000]), "bounds: too large .a world spans at most 10 km"),
        (lambda c: c["roads"][0].update(line=[[-4000, 0], [4000, 0]] * 100), "roads: too long .* maximum"),
        (lambda c: c.update(trees=[{}] * 60_000), "trees.0.x: Field required"),
        (lambda c: c.update(trees=[[]] * 1_600_000), "too large .more than the maximum of 1,500,000"),
    ],
)  # fmt: skip
def test_a_bad_world_file_is_refused(
    change: Change, complaint: str, block: str, tmp_path: Path
) -> None:
    content = json.loads(block)
    change(content)
    (tmp_path / "bad.json").write_text(json.dumps(content))
    check_refused(tmp_path / "bad.json", complaint)


@pytest.mark.parametrize(
    ("kind", "content", "complaint"),
    [
        ("osm", BILLION_LAUGHS, "contains <!DOCTYPE; maps with document types or entities are"),
        ("osm", "<osm>" + " " * 2_000_000 + "<!ENTITY a 'b'>", "contains <!ENTITY"),
        ("osm", BILLION_LAUGHS.encode("utf-16"), "contains zero bytes"),
        ("osm", CAMPUS[: len(CAMPUS) // 2], "not a readable OpenStreetMap XML file"),
        ("osm", "<html><body/></html>", "not a readable OpenStreetMap XML file"),
        ("osm", f'<osm version="0.6">{POINT}{WAYS}</osm>', "more than 10,000 points"),
        ("osm", CAMPUS.replace('"highway"', '"highroad"'), "the map has no roads"),
        ("osm", CAMPUS.replace('"building"', '"bidding"'), "the map has no buildings"),
        ("osm", CAMPUS.replace('v="victim"', 'v="start"'), "2 nodes are tagged smal:role=start"),
        ("osm", CAMPUS.replace('"direction" v="0"', '"direction" v="nan"'), "direction=nan"),
        ("osm", b"", "too large .1074 MB > maximum 67 MB"),
        ("json", b"", "too large .1074 MB > maximum 34 MB"),
        ("json", b"{", "Invalid JSON"),
        ("json", b'{"format": ' + b"[" * 200_000, "recursion limit"),
        ("json", b'{"format": ' + b"9" * 10_000 + b"}", "Invalid JSON: number out of range"),
        ("json", b'{"format": "\\u001b[2J"}', r"tag '\?\[2J' found using 'format'"),
    ],
    ids=range(16),
)
def test_a_file_that_is_no_world_is_refused(
    kind: str, content: str | bytes, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(osm, "MOST_POINTS", 10_000)
    path = tmp_path / f"bad.{kind}"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    if not content:
        os.truncate(path, 1 << 30)
    check_refused(path, complaint)
