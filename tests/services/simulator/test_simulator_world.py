"""Worlds: ours say what they should, a real extract loads, and every broken file gives one clear line."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from services.simulator.world import World, WorldError, load_world, looks
from services.simulator.world.collision import obstacles_of
from services.simulator.world.loading import WORLDS_FOLDER
from services.simulator.world.osm import read_osm
from services.simulator.world.route import plan_route, route_length_m
from services.simulator.world.terrain import Terrain

BROWN = Path(__file__).parents[4] / "shared" / "data" / "osm" / "brown_university_campus.osm"
CAMPUS = (WORLDS_FOLDER / "campus.osm").read_text()
BILLION_LAUGHS = (
    '<!DOCTYPE osm [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    + ']><osm version="0.6"><node id="1" version="1" lat="1" lon="1"><tag k="name" v="&a9;"/></node></osm>'
)
STRANGE_FILE = (
    '<!DOCTYPE osm [<!ENTITY file SYSTEM "file:///etc/hostname">]><osm version="0.6">'
    '<node id="1" version="1" lat="1" lon="1"><tag k="natural" v="&file;"/></node></osm>'
)


def turns(world: World) -> int:
    legs = np.diff(plan_route(world, (world.start.x, world.start.y)), axis=0)
    angles = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    return int((np.abs(np.diff(angles)) > np.radians(30)).sum())


def test_the_campus_is_as_large_and_as_ambiguous_as_the_issue_asks() -> None:
    world = load_world("campus")
    x_min, y_min, x_max, y_max = world.place.bounds
    assert (x_max - x_min, y_max - y_min) == pytest.approx((200, 200), abs=0.5)
    assert len(world.place.buildings) >= 25
    assert world.place.skipped == 0
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    assert 80 <= route.length <= 110
    assert 3 <= turns(world) <= 5
    beside = [building.facade for building in world.place.buildings if building.footprint.distance(route) < 6]
    assert max(beside.count(facade) for facade in beside) >= 4, "the route passes houses that look the same"
    assert len({building.facade for building in world.place.buildings}) >= 20


def test_no_building_of_our_worlds_stands_on_a_road_or_in_another_building() -> None:
    for name in ("campus", "yard"):
        world = load_world(name)
        footprints = [building.footprint for building in world.place.buildings]
        roads = shapely.union_all([road.line.buffer(road.width_m / 2) for road in world.place.roads])
        assert not any(footprint.intersects(roads) for footprint in footprints)
        assert shapely.union_all(footprints).area == pytest.approx(sum(footprint.area for footprint in footprints))


def test_the_yard_is_small() -> None:
    world = load_world("yard")
    assert len(world.place.buildings) >= 6
    assert 25 <= route_length_m(plan_route(world, (world.start.x, world.start.y))) <= 32


@pytest.mark.parametrize(("latitude", "east_m", "north_m"), [(0.0, 111.320, 110.574), (45.0, 78.847, 111.132)])
def test_metres_are_metres(tmp_path: Path, latitude: float, east_m: float, north_m: float) -> None:
    """A thousandth of a degree on the WGS 84 ellipsoid, from published tables."""
    low, high = latitude - 0.0005, latitude + 0.0005
    path = tmp_path / "empty.osm"
    path.write_text(
        f'<osm version="0.6"><bounds minlat="{low}" minlon="7.0000" maxlat="{high}" maxlon="7.0010"/>'
        f'<node id="1" version="1" lat="{high}" lon="7.0010"><tag k="natural" v="tree"/></node></osm>'
    )
    extract = read_osm(path)
    np.testing.assert_allclose(extract.bounds, [-east_m / 2, -north_m / 2, east_m / 2, north_m / 2], atol=2e-3)
    np.testing.assert_allclose(extract.nodes[0].xy, [east_m / 2, north_m / 2], atol=2e-2)


@pytest.mark.skipif(not BROWN.exists(), reason=f"the real extract is not on this machine: {BROWN}")
def test_a_real_extract_gets_a_hidden_victim_by_rule() -> None:
    world = load_world(BROWN)
    assert len(world.place.buildings) > 350
    assert len(world.place.trees) == 32
    again = load_world(BROWN)
    assert (world.start, world.victim) == (again.start, again.victim)
    sight = np.array([[(world.start.x, world.start.y), (world.victim.x, world.victim.y)]])
    assert not obstacles_of(world.place).in_sight(sight)[0]
    assert 55 <= route_length_m(plan_route(world, (world.start.x, world.start.y))) <= 150


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (BILLION_LAUGHS, "holds <!DOCTYPE; a map defines no document type and no entities"),
        (STRANGE_FILE, "holds <!DOCTYPE"),
        ("<osm>" + " " * 2_000_000 + "<!ENTITY a 'b'>", "holds <!ENTITY"),
        (BILLION_LAUGHS.encode("utf-16").decode("latin-1"), "holds zero bytes"),
        (CAMPUS[: len(CAMPUS) // 2], "not a readable OpenStreetMap XML file"),
        ("", "not a readable OpenStreetMap XML file"),
        ("a letter to a friend", "not a readable OpenStreetMap XML file"),
        ("<html><body/></html>", "not a readable OpenStreetMap XML file"),
        ('<osm version="0.6"></osm>', "no located nodes or ways"),
        (CAMPUS.replace('"highway"', '"highroad"'), "the map has no roads"),
        (CAMPUS.replace('"building"', '"bidding"'), "the map has no buildings"),
        (CAMPUS.replace('v="victim"', 'v="start"'), "2 nodes are tagged smal:role=start"),
        (CAMPUS.replace('k="direction" v="0"', 'k="direction" v="nan"'), "direction=nan"),
    ],
)
def test_a_bad_file_gives_one_line_that_names_it(tmp_path: Path, content: str, complaint: str) -> None:
    path = tmp_path / "bad.osm"
    path.write_bytes(content.encode("latin-1" if "\0" in content else "utf-8"))
    began_s = time.process_time()
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert time.process_time() - began_s < 2
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_100_mb_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.osm"
    with path.open("wb") as file:
        file.truncate(100_000_000)
    with pytest.raises(WorldError, match=r"large\.osm: 100 MB; a map has at most 67 MB"):
        load_world(path)


def test_more_points_than_a_world_can_have_are_refused_while_reading(tmp_path: Path) -> None:
    path = tmp_path / "long.osm"
    way = '<way id="{}" version="1">' + '<nd ref="1"/>' * 2000 + "</way>"
    ways = "".join(way.format(k) for k in range(1, 510))
    path.write_text(f'<osm version="0.6"><node id="1" version="1" lat="1" lon="1"/>{ways}</osm>')
    with pytest.raises(WorldError, match="more than 1,000,000 points"):
        load_world(path)


@pytest.mark.skipif(not BROWN.exists(), reason=f"the real extract is not on this machine: {BROWN}")
def test_every_building_of_a_real_extract_is_accounted_for() -> None:
    """As many as a plain reading of the XML finds: drawn, or skipped for a reason."""
    tagged: Counter[str] = Counter()
    for element in ElementTree.parse(BROWN).getroot():  # noqa: S314 - our own copy
        tags = {tag.get("k"): tag.get("v") for tag in element.iter("tag")}
        if tags.get("building", "no") != "no":
            tagged[element.tag] += 1
    place = load_world(BROWN).place
    assert isinstance(place, Terrain)
    assert place.source is not None
    assert tagged == {"way": 392, "node": 9, "relation": 1}
    skipped = {reason: count for reason, count in place.source.skipped.items() if reason.startswith("building: ")}
    assert skipped == {"building: it is a point without an outline": 9, "building: it is smaller than 4 m2": 3}
    assert place.source.used["building"] + sum(skipped.values()) == tagged.total()
    assert place.source.used["building relation"] == tagged["relation"]
    (hall,) = [building for building in place.buildings if building.footprint.interiors]
    assert hall.footprint.interiors


def test_an_unknown_world_names_those_that_are_known() -> None:
    with pytest.raises(WorldError, match=r"unknown world 'moon'; known are campus, .*yard"):
        load_world("moon")
    with pytest.raises(WorldError, match=r"moon\.osm: no such file"):
        load_world("somewhere/moon.osm")


def test_broken_ways_are_left_out_and_counted(tmp_path: Path) -> None:
    broken = """
      <way id="900001" version="1"><nd ref="1"/><nd ref="987654321"/><tag k="highway" v="service"/></way>
      <way id="900002" version="1"><tag k="building" v="yes"/></way>
      <way id="900003" version="1"><nd ref="1"/><nd ref="2"/><tag k="building" v="yes"/></way></osm>"""
    path = tmp_path / "broken.osm"
    path.write_text(CAMPUS.replace("</osm>", broken))
    world = load_world(path)
    assert world.place.skipped == 3
    assert len(world.place.buildings) == len(load_world("campus").place.buildings)


def test_a_world_without_roles_gets_them_by_rule(tmp_path: Path) -> None:
    path = tmp_path / "plain.osm"
    path.write_text(CAMPUS.replace('"smal:role"', '"note"'))
    world = load_world(path)
    assert obstacles_of(world.place).is_free(world.start.x, world.start.y)
    assert 50 <= route_length_m(plan_route(world, (world.start.x, world.start.y))) <= 150


@pytest.mark.parametrize(
    ("text", "value"),
    [("12", 12.0), ("12.5 m", 12.5), ("12,5", 12.5), ("40'", 12.192), ("high", None), (None, None), ("-3", None)],
)
def test_lengths_are_read_as_people_write_them(text: str | None, value: float | None) -> None:
    assert looks.metres(text) == pytest.approx(value)


def test_the_facade_tag_makes_buildings_alike_and_its_absence_keeps_them_apart() -> None:
    tags = {"building": "house", "building:material": "brick", "smal:facade": "a"}
    assert looks.facade(tags, 1) == looks.facade(tags, 2)
    assert looks.facade(tags, 1) != looks.facade({**tags, "smal:facade": "b"}, 1)
    plain = {"building": "yes"}
    assert len({looks.facade(plain, way) for way in range(40)}) > 10
