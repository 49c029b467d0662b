"""``load_world`` of an OpenStreetMap file, and everything that it is turned into."""

from __future__ import annotations

import random
import re

from services.simulator.world.loading import WORLDS_FOLDER, load_world
from services.simulator.world.place import WorldError
from tests.fuzz.targets import check_line, scratch

_ELEMENT = re.compile(r"<(node|way|bounds|nd|tag)\b[^>]*?/>|<(node|way)\b.*?</\2>", re.DOTALL)
_VALUE = re.compile(r'"[^"]*"')
_ODD = [
    "", "0", "-1", "1", "3", "90", "180", "-180", "90.0001", "1e9", "nan", "inf", "9" * 400, "0.0000001", "yes", "no",
    "٣", "a\n", "&#10;", "&#27;[2J", "&amp;", "&x;", "highway", "building", "natural", "water", "tree", "barrier",
    "wall", "smal:role", "start", "victim", "direction", "height", "width", "9223372036854775807", "é" * 300,
]  # fmt: skip


def seeds() -> list[bytes]:
    yard = (WORLDS_FOLDER / "yard.osm").read_text()
    return [yard.encode(), yard.replace('"smal:role"', '"note"').encode(), re.sub(r"<bounds[^>]*>", "", yard).encode()]


def run(data: bytes) -> bool:
    try:
        world = load_world(scratch.file_of(data, "x.osm"))
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
