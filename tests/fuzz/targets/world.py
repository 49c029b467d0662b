"""``load_world`` of an OpenStreetMap file, and everything that it is turned into."""

from __future__ import annotations

import random
import re

from services.simulator.world.loading import WORLDS_FOLDER, load_world
from services.simulator.world.place import WorldError
from tests.fuzz.targets import check_line, scratch

_ELEMENT = re.compile(r"<(node|way|bounds|nd|tag|member)\b[^>]*?/>|<(node|way|relation)\b.*?</\2>", re.DOTALL)
_VALUE = re.compile(r'"[^"]*"')
_ODD = [
    "", "0", "-1", "1", "3", "90", "180", "-180", "90.0001", "1e9", "nan", "inf", "9" * 400, "0.0000001", "yes", "no",
    "٣", "a\n", "&#10;", "&#27;[2J", "&amp;", "&x;", "highway", "building", "natural", "water", "tree", "barrier",
    "wall", "multipolygon", "inner", "outer", "building:part", "tunnel", "building_passage", "waterway", "tree_row",
    "wood", "roof:height", "gabled", "lanes", "sidewalk", "area", "pedestrian", "2",
    "smal:role", "start", "victim", "direction", "height", "width", "9223372036854775807", "é" * 300,
]  # fmt: skip


# Beside what our worlds have: a courtyard, a part, a passage, water under a bridge, a wood, a row, a square, a gate.
_MORE = """
  <node id="9001" version="1" lat="39.74615" lon="-105.21895"><tag k="barrier" v="gate"/></node>
  <node id="9002" version="1" lat="39.74615" lon="-105.21885"/>
  <node id="9003" version="1" lat="39.74625" lon="-105.21885"/>
  <node id="9004" version="1" lat="39.74625" lon="-105.21895"/>
  <node id="9005" version="1" lat="39.74618" lon="-105.21892"/>
  <node id="9006" version="1" lat="39.74618" lon="-105.21888"/>
  <node id="9007" version="1" lat="39.74622" lon="-105.21890"/>
  <way id="9010" version="1"><nd ref="9001"/><nd ref="9002"/><nd ref="9003"/></way>
  <way id="9011" version="1"><nd ref="9003"/><nd ref="9004"/><nd ref="9001"/></way>
  <way id="9012" version="1"><nd ref="9005"/><nd ref="9006"/><nd ref="9007"/><nd ref="9005"/>
    <tag k="natural" v="wood"/><tag k="leaf_type" v="mixed"/></way>
  <way id="9013" version="1"><nd ref="9001"/><nd ref="9002"/><nd ref="9003"/><nd ref="9004"/><nd ref="9001"/>
    <tag k="building:part" v="yes"/><tag k="height" v="9"/><tag k="roof:shape" v="gabled"/>
    <tag k="roof:height" v="3"/><tag k="min_height" v="2"/></way>
  <way id="9014" version="1"><nd ref="9001"/><nd ref="9003"/><tag k="highway" v="footway"/>
    <tag k="tunnel" v="building_passage"/><tag k="lanes" v="2"/><tag k="sidewalk" v="left"/></way>
  <way id="9015" version="1"><nd ref="9004"/><nd ref="9002"/><tag k="waterway" v="river"/><tag k="width" v="3"/></way>
  <way id="9016" version="1"><nd ref="9004"/><nd ref="9001"/><nd ref="9002"/><tag k="barrier" v="wall"/>
    <tag k="natural" v="tree_row"/></way>
  <way id="9017" version="1"><nd ref="9001"/><nd ref="9002"/><nd ref="9003"/><nd ref="9001"/>
    <tag k="highway" v="pedestrian"/><tag k="area" v="yes"/></way>
  <relation id="9020" version="1"><member type="way" ref="9010" role="outer"/>
    <member type="way" ref="9011" role="outer"/>
    <member type="way" ref="9012" role="inner"/><tag k="type" v="multipolygon"/><tag k="building" v="house"/>
    <tag k="building:levels" v="3"/></relation>
</osm>"""


def seeds() -> list[bytes]:
    yard = (WORLDS_FOLDER / "yard.osm").read_text()
    plain = yard.replace('"smal:role"', '"note"')
    return [
        yard.encode(), plain.encode(), re.sub(r"<bounds[^>]*>", "", yard).encode(),
        yard.replace("</osm>", _MORE).encode(), plain.replace("</osm>", _MORE).encode(),
    ]  # fmt: skip


def run(data: bytes) -> bool:
    return loads(data, "x.osm")


def loads(data: bytes, name: str) -> bool:
    """Load a world of a file of that name; whether it is one, and then its task lies inside it."""
    try:
        world = load_world(scratch.file_of(data, name))
    except WorldError as error:
        check_line(error)
        return False
    x_min, y_min, x_max, y_max = world.place.bounds
    for pose in (world.start, world.victim):
        assert x_min <= pose.x <= x_max
        assert y_min <= pose.y <= y_max
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    text = data.decode(errors="replace")
    elements, values = list(_ELEMENT.finditer(text)), list(_VALUE.finditer(text))
    if not elements or not values or rng.random() < 0.1:
        return None
    one, other = rng.choice(elements), rng.choice(elements)
    match rng.randrange(8):
        case 0:
            text = text[: one.start()] + text[one.end() :]
        case 1:
            text = text[: one.start()] + other[0] + text[one.start() :]
        case 2:
            text = text[: one.start()] + other[0] + text[one.end() :]
        case _:
            value = rng.choice(values)
            new = rng.choice([f'"{rng.choice(_ODD)}"', rng.choice(values)[0]])
            text = text[: value.start()] + new + text[value.end() :]
    return text.encode()
