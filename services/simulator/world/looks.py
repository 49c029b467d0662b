"""How a building looks, from its tags: storeys, wall material, colour, roof."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from typing import Final

from services.simulator.world.place import Rgb
from services.simulator.world.terrain import Facade, FacadeStyle, RoofShape

Tags = Mapping[str, str]

_STYLE_OF_MATERIAL: Final[dict[str, FacadeStyle]] = {
    "brick": "brick", "plaster": "plaster", "stucco": "plaster", "render": "plaster", "concrete": "concrete",
    "stone": "concrete", "limestone": "concrete", "glass": "glass", "mirror": "glass", "metal": "glass",
    "wood": "wood", "timber_framing": "wood",
}  # fmt: skip
_STYLES_OF_USE: Final[dict[str, tuple[FacadeStyle, ...]]] = {
    "house": ("wood", "plaster", "brick"), "detached": ("wood", "plaster"), "residential": ("brick", "plaster", "wood"),
    "apartments": ("plaster", "brick", "concrete"), "dormitory": ("brick", "plaster"), "office": ("glass", "concrete"),
    "commercial": ("glass", "concrete"), "garage": ("concrete",), "garages": ("concrete",), "shed": ("wood",),
}  # fmt: skip
_ANY_STYLE: Final[tuple[FacadeStyle, ...]] = ("brick", "plaster", "concrete", "brick", "glass")
_COLOURS: Final[dict[str, Rgb]] = {
    "white": (232, 230, 224), "grey": (150, 150, 148), "gray": (150, 150, 148), "black": (60, 60, 62),
    "red": (168, 72, 58), "maroon": (120, 52, 46), "brown": (126, 92, 66), "beige": (216, 200, 168),
    "yellow": (222, 192, 110), "orange": (206, 134, 78), "green": (122, 146, 110), "olive": (128, 128, 84),
    "blue": (112, 138, 172), "teal": (96, 140, 140), "pink": (214, 168, 160), "cream": (234, 222, 192),
}  # fmt: skip
_STOREY_M: Final = 3.0
_TALLEST_M: Final = 400.0
# Most buildings of a real extract say nothing of their look; this many looks of each style keep neighbours apart.
_VARIANTS: Final = 8


def metres(text: str | None) -> float | None:
    """Read an OpenStreetMap length: "12", "12.5 m", "12,5" or "40'" (feet); None where there is none to read."""
    found = re.fullmatch(r"\s*(\d+(?:[.,]\d+)?)\s*(m|ft|')?\s*", text or "")
    if found is None:
        return None
    value = float(found[1].replace(",", "."))
    return value * 0.3048 if found[2] in {"ft", "'"} else value


def height_m(tags: Tags) -> float:
    """Return a building's height in metres: its `height`, else 3 m a level, else what its use suggests."""
    levels = metres(tags.get("building:levels"))
    low_use = tags.get("building") in {"house", "detached", "garage", "garages", "shed", "roof", "hut"}
    guess = levels * _STOREY_M if levels else (2 if low_use else 3) * _STOREY_M
    return min(max(metres(tags.get("height")) or guess, 2.5), _TALLEST_M)


def facade(tags: Tags, way_id: int) -> Facade:
    """Return the look of a building's walls.

    Buildings with the same `smal:facade` and the same style and colour look identical, which is how a world makes
    places alike on purpose. Without that tag the way's number picks one of a few looks, so that neighbours differ.
    """
    named = tags.get("smal:facade")
    variant = zlib.crc32(named.encode()) % 997 if named else way_id % _VARIANTS
    return Facade(_style(tags, way_id), _colour(tags.get("building:colour")), variant)


def roof_shape(tags: Tags) -> RoofShape:
    """Return the roof to draw; every pitched shape is drawn hipped."""
    return "flat" if tags.get("roof:shape", "flat") in {"flat", "skillion", "dome", "round"} else "hipped"


def _style(tags: Tags, way_id: int) -> FacadeStyle:
    stated = _STYLE_OF_MATERIAL.get(tags.get("building:material", ""))
    if stated is not None:
        return stated
    choices = _STYLES_OF_USE.get(tags.get("building", ""), _ANY_STYLE)
    # A stable mix of the number, since neighbours often have consecutive ones.
    return choices[zlib.crc32(str(way_id).encode()) % len(choices)]


def _colour(text: str | None) -> Rgb | None:
    if text is None:
        return None
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    return _COLOURS.get(text.lower())
