"""How a building looks, from its tags: storeys, wall material, colour, roof."""

from __future__ import annotations

import math
import re
import zlib
from typing import TYPE_CHECKING, Final

import shapely

from services.simulator.world.place import Rgb
from services.simulator.world.terrain import Facade, FacadeStyle, RoofShape

if TYPE_CHECKING:
    from shapely import Polygon

    from services.simulator.world.kinds import Tags

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
    "silver": (182, 184, 186), "tan": (196, 168, 130), "sandybrown": (214, 170, 118), "darkred": (120, 52, 46),
    "blue": (112, 138, 172), "teal": (96, 140, 140), "pink": (214, 168, 160), "cream": (234, 222, 192),
}  # fmt: skip
_ROOFS: Final[dict[str, RoofShape]] = {
    "flat": "flat", "skillion": "flat", "dome": "flat", "round": "flat", "onion": "flat", "cone": "flat",
    "gabled": "gabled", "gambrel": "gabled", "saltbox": "gabled", "double_saltbox": "gabled",
    "gabled_height_moved": "gabled", "quadruple_saltbox": "gabled", "side_hipped": "gabled",
    "hipped": "hipped", "half-hipped": "hipped", "mansard": "hipped", "pyramidal": "hipped", "many": "hipped",
    "hipped-and-gabled": "hipped",
}  # fmt: skip
_HOUSES: Final = frozenset({"house", "detached", "semidetached_house", "semi", "terrace", "bungalow", "farm", "cabin"})
_ROOF_MATERIALS: Final[dict[str, Rgb]] = {
    "roof_tiles": (158, 88, 66), "tile": (158, 88, 66), "slate": (86, 90, 98), "metal": (146, 150, 154),
    "metal_sheet": (146, 150, 154), "zinc": (150, 156, 162), "copper": (112, 152, 136), "tar_paper": (74, 74, 76),
    "asphalt": (74, 74, 76), "asphalt_shingle": (92, 88, 86), "concrete": (164, 160, 152), "gravel": (150, 144, 132),
    "grass": (104, 132, 82), "thatch": (158, 134, 88), "wood": (126, 92, 66), "glass": (128, 150, 164),
    "eternit": (132, 132, 128),
}  # fmt: skip
_OPEN_BELOW: Final = frozenset({"roof", "carport", "canopy"})
_CANOPY_M: Final = 4.0
_SLAB_M: Final = 0.4
_STOREY_M: Final = 3.0
_ROOF_STOREY_M: Final = 2.5
_LOWEST_M: Final = 2.5
_TALLEST_M: Final = 400.0
_ROOF_SLOPE: Final = 0.6
_OVERHANG_M: Final = 0.4
_LOWEST_ROOF_M: Final = 0.3
_HIGHEST_ROOF_M: Final = 40.0
_STEEPEST_DEG: Final = 75.0
_ABOUT_A_RECTANGLE: Final = 0.85
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
    """Return the height of a building's eaves in metres: its `height`, else 3 m a level, else what its use suggests.

    OpenStreetMap's `height` is that of the ridge, so a stated height of the roof is taken off; where none is stated,
    the walls are taken to be as high as the map says.
    """
    levels = metres(tags.get("building:levels"))
    use = tags.get("building")
    low_use = use in {"house", "detached", "garage", "garages", "shed", "roof", "hut"}
    guess = levels * _STOREY_M if levels else (2 if low_use else 3) * _STOREY_M
    if use in _OPEN_BELOW and not levels:
        guess = _CANOPY_M
    total = metres(tags.get("height"))
    if total is None:
        return min(max(guess, _LOWEST_M), _TALLEST_M)
    roof = _stated_roof_m(tags) or 0.0
    return min(max(total - min(roof, total / 2), _LOWEST_M), _TALLEST_M)


def min_height_m(tags: Tags) -> float:
    """Return where a building's walls begin: its `min_height`, else 3 m a level below it; a canopy is a thin slab."""
    stated = metres(tags.get("min_height"))
    levels = metres(tags.get("building:min_level"))
    top = height_m(tags)
    lowest = top - _SLAB_M if tags.get("building", tags.get("building:part")) in _OPEN_BELOW else 0.0
    begin = stated if stated is not None else levels * _STOREY_M if levels is not None else lowest
    return min(begin, top - _SLAB_M)


def facade(tags: Tags, way_id: int) -> Facade:
    """Return the look of a building's walls.

    Buildings with the same `smal:facade` and the same style and colour look identical, which is how a world makes
    places alike on purpose. Without that tag the way's number picks one of a few looks, so that neighbours differ.
    """
    named = tags.get("smal:facade")
    variant = zlib.crc32(named.encode()) % 997 if named else way_id % _VARIANTS
    return Facade(_style(tags, way_id), _colour(tags.get("building:colour")), variant)


def roof(tags: Tags, footprint: Polygon) -> tuple[RoofShape, float]:
    """Return the roof to draw, and how far its ridge is above the eaves in metres (0 for a flat one).

    Shapes that we cannot draw get the nearest one. A house that says nothing has a gabled roof if its footprint is
    about a rectangle, every other building a flat one.
    """
    stated = tags.get("roof:shape")
    shape = _ROOFS.get(stated, "flat") if stated is not None else _usual_roof(tags, footprint)
    if shape == "flat":
        return "flat", 0.0
    half_width = _half_width_m(footprint)
    height = _stated_roof_m(tags)
    if height is None:
        angle = metres((tags.get("roof:angle") or "").removesuffix("°"))
        slope = math.tan(math.radians(min(angle, _STEEPEST_DEG))) if angle else _ROOF_SLOPE
        height = (half_width + _OVERHANG_M) * slope
    return shape, min(max(height, _LOWEST_ROOF_M), _HIGHEST_ROOF_M)


def roof_colour(tags: Tags) -> Rgb | None:
    """Return the colour of the roof: as stated, else that of its material, else None."""
    return _colour(tags.get("roof:colour")) or _ROOF_MATERIALS.get(tags.get("roof:material", ""))


def _stated_roof_m(tags: Tags) -> float | None:
    """Return the height of a pitched roof, where its height or its levels are stated."""
    if _ROOFS.get(tags.get("roof:shape", ""), "flat") == "flat":
        return None
    levels = metres(tags.get("roof:levels"))
    return metres(tags.get("roof:height")) or (levels * _ROOF_STOREY_M if levels else None)


def _usual_roof(tags: Tags, footprint: Polygon) -> RoofShape:
    if tags.get("building") not in _HOUSES or "building:part" in tags or footprint.interiors:
        return "flat"
    box = shapely.oriented_envelope(footprint)
    return "gabled" if footprint.area > _ABOUT_A_RECTANGLE * box.area else "flat"


def _half_width_m(footprint: Polygon) -> float:
    """Return half of the shorter side of the smallest rectangle about a footprint."""
    corners = shapely.get_coordinates(shapely.oriented_envelope(footprint))
    return float(min(math.dist(corners[0], corners[1]), math.dist(corners[1], corners[2]))) / 2


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
    if re.fullmatch(r"#[0-9a-fA-F]{3}", text):
        text = "#" + "".join(2 * digit for digit in text[1:])
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    name = text.lower().replace("_", "").replace(" ", "")
    shade = next((shade for shade in ("light", "dark") if name.startswith(shade)), "")
    return _COLOURS.get(name) or _shaded(_COLOURS.get(name.removeprefix(shade)), shade)


def _shaded(colour: Rgb | None, shade: str) -> Rgb | None:
    if colour is None:
        return None
    red, green, blue = ((value + 255) // 2 if shade == "light" else value * 2 // 3 for value in colour)
    return red, green, blue
