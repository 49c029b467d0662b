"""Maps and world files: valid ones load, broken objects are counted, hostile files are one clear line."""

import bz2
import gzip
import json
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import osmium
import pytest

from services.simulator.world import World, WorldError, load_world, osm
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from services.simulator.world.route import obstacles_of, plan_route, route_length_m
from services.simulator.world.terrain import terrain_text
from tests.services.simulator.map_text import LONGITUDE, MapText, block_of_houses, corners

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


def in_format(text: str, suffix: str, folder: Path) -> Path:
    """Write a map in a format of OpenStreetMap."""
    plain = folder / "town.osm"
    plain.write_text(text)
    pack = {".gz": gzip.compress, ".bz2": bz2.compress}.get(suffix)
    path = folder / f"town.osm{suffix}"
    if pack is not None:
        path.write_bytes(pack(text.encode()))
    elif suffix:
        with osmium.SimpleWriter(str(path)) as writer:
            for element in osmium.FileProcessor(str(plain)):
                writer.add(element)
    return path


@pytest.mark.parametrize("suffix", ["", ".gz", ".bz2", ".pbf"])
def test_map_is_the_same_in_every_format(suffix: str, tmp_path: Path) -> None:
    world = load_world(in_format(block_of_houses().text(), suffix, tmp_path))
    assert len(world.place.buildings) == 6
    assert len(world.place.roads) == 1
    assert world.name == "town"


def test_map_of_josm_has_negative_ids_and_deletions(tmp_path: Path) -> None:
    text = re.sub(r'(id|ref)="(\d+)"', r'\1="-\2"', block_of_houses().text())
    gone = """<way id='-900' action='delete' visible='true' version='1'>"""
    again = re.search(r'<way id="-\d+" version="1">(<nd [^>]*>)+<tag k="building".*', text)
    text = text.replace("</osm>", f"{gone}{again[1]}<tag k='building' v='yes'/></way>\n</osm>")
    (tmp_path / "new.osm").write_text(text)
    assert len(load_world(tmp_path / "new.osm").place.buildings) == 6
    ids = [number for number in re.findall(r'<way id="(-\d+)"', text) if number in again[0]]
    deleted = text.replace(f'<way id="{ids[0]}"', f'<way id="{ids[0]}" action="delete"')
    (tmp_path / "new.osm").write_text(deleted)
    assert len(load_world(tmp_path / "new.osm").place.buildings) == 5
    hidden = text.replace(f'<way id="{ids[0]}"', f'<way id="{ids[0]}" visible="false"')
    (tmp_path / "new.osm").write_text(hidden)
    assert len(load_world(tmp_path / "new.osm").place.buildings) == 5


def test_map_across_the_antimeridian_is_as_elsewhere(tmp_path: Path) -> None:
    def moved(found: re.Match[str]) -> str:
        return f'{found[1]}"{(float(found[2]) - LONGITUDE + 360.0) % 360.0 - 180.0:.7f}"'

    text = block_of_houses().text()
    (tmp_path / "here.osm").write_text(text)
    (tmp_path / "there.osm").write_text(re.sub(r'(\w*lon=)"([^"]+)"', moved, text))
    here = load_world(tmp_path / "here.osm")
    there = load_world(tmp_path / "there.osm")
    assert there.place.bounds == pytest.approx(here.place.bounds, abs=0.05)
    assert (there.start.x, there.start.y) == pytest.approx((here.start.x, here.start.y), abs=0.05)
    assert abs(there.place.source.longitude_deg) == pytest.approx(180.0, abs=1e-6)


def test_bounds_hold_a_building_drawn_by_its_relation(tmp_path: Path) -> None:
    made = block_of_houses()
    outline = made.way(corners(0, 95, 40, 30))
    made.multipolygon([outline], building="yes")
    text = re.sub(r"<bounds[^>]*>", "", made.text())
    (tmp_path / "town.osm").write_text(text)
    assert len(load_world(tmp_path / "town.osm").place.buildings) == 7


@pytest.mark.parametrize(
    ("tags", "height_m"),
    [
        ({"building": "yes", "height": "12'6\""}, 3.81),
        ({"building": "yes", "height": "12 ft"}, 3.658),
        ({"building": "yes", "height": "12,5"}, 12.5),
        ({"building": "proposed", "height": "12"}, None),
        ({"building": "no", "height": "12"}, None),
    ],
)
def test_building_has_the_height_of_its_tag(
    tags: dict[str, str], height_m: float | None, tmp_path: Path
) -> None:
    made = block_of_houses()
    made.box(80, 0, 16, 12, **tags)
    world = load_world(made.write(tmp_path / "town.osm"))
    heights = [one.height_m for one in world.place.buildings[6:]]
    assert heights == ([] if height_m is None else [pytest.approx(height_m, abs=0.01)])


def test_map_is_refused_when_it_has_too_many_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(osm, "MOST_NODES", 20)
    path = in_format(block_of_houses().text(), ".gz", tmp_path)
    with pytest.raises(WorldError, match="more than 20 nodes"):
        load_world(path)


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
        ("osm", BILLION_LAUGHS, "XML entities are not supported"),
        ("osm", "<osm>" + " " * 2_000_000 + "<!ENTITY a 'b'>", "not a readable OpenStreetMap file"),
        ("osm", BILLION_LAUGHS.encode("utf-16"), "XML entities are not supported"),
        ("osm", CAMPUS[: len(CAMPUS) // 2], "not a readable OpenStreetMap file"),
        ("osm", gzip.compress(CAMPUS.encode())[:-900], "not a readable OpenStreetMap file"),
        ("osm", "<html><body/></html>", "not an OpenStreetMap file but a web page; download"),
        ("osm", '{"version": 0.6, "elements": []}', "but JSON; ask Overpass for XML"),
        ("osm", b"PK\x03\x04" + bytes(90), "but a ZIP archive; unpack it first"),
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
    ids=range(19),
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
