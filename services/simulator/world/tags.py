"""Meanings of OpenStreetMap tags: kind, length, width, colour."""

import re
from dataclasses import dataclass
from typing import Final, Literal

from services.simulator.tables import table
from services.simulator.world.osm import Tags
from services.simulator.world.place import Rgb
from services.simulator.world.terrain import AreaKind, BarrierKind, FacadeStyle, RoofShape

Kind = Literal[
    "building",
    "building part",
    "road",
    "square",
    "area",
    "wood",
    "waterway",
    "barrier",
    "row",
    "tree",
]
Names = frozenset[str]


@dataclass(frozen=True)
class Meanings:
    """The table `openstreetmap`."""

    not_for_a_robot: Names
    marked: Names
    gates: Names
    hard: Names
    below_ground: Names
    houses: Names
    low: Names
    open_below: Names
    any_style: tuple[FacadeStyle, ...]
    street_width_m: dict[str, float]
    path_width_m: dict[str, float]
    waterway_width_m: dict[str, float]
    barriers: dict[str, tuple[BarrierKind, float]]
    covers: dict[str, dict[str, AreaKind]]
    woods: dict[str, dict[str, float]]
    colours: dict[str, Rgb]
    style_of_material: dict[str, FacadeStyle]
    styles_of_use: dict[str, tuple[FacadeStyle, ...]]
    roofs: dict[str, RoofShape]
    roof_materials: dict[str, Rgb]


_FEET: Final = ("ft", "'")
#: Values of "building" without a building.
_ABSENT: Final = frozenset({"no", "proposed", "demolished", "razed"})
MEANINGS: Final = table("openstreetmap", Meanings)


def kinds_of(tags: Tags) -> list[Kind]:
    """Return the kinds of objects that a way or relation represents, usually one or none."""
    if tags.get("building", "no") not in _ABSENT:
        return ["building"]
    if tags.get("building:part", "no") not in _ABSENT:
        return ["building part"]
    found: list[Kind] = []
    if (
        tags.get("highway") in MEANINGS.street_width_m
        or tags.get("highway") in MEANINGS.path_width_m
    ):
        # An area is paved ground between its outlines instead of a line.
        found.append(
            "square" if tags.get("area") == "yes" or tags.get("type") == "multipolygon" else "road"
        )
    if tags.get("barrier") in MEANINGS.barriers:
        found.append("barrier")
    if tags.get("natural") == "tree_row":
        found.append("row")
    if tags.get("waterway") in MEANINGS.waterway_width_m:
        found.append("waterway")
    if cover_of(tags) is not None and "square" not in found:
        found.append("area" if trees_on(tags) is None else "wood")
    return found


def cover_of(tags: Tags) -> AreaKind | None:
    """Return the ground cover of an area, or None without a known tag."""
    if tags.get("parking") in MEANINGS.below_ground:
        return None
    cover = next(
        (kinds[tags[key]] for key, kinds in MEANINGS.covers.items() if tags.get(key) in kinds), None
    )
    bare = cover == "grass" and tags.get("surface") in MEANINGS.hard and trees_on(tags) is None
    return "paved" if bare else cover


def trees_on(tags: Tags) -> float | None:
    """Return the height of trees on an area, metres (0: default); None without trees."""
    key = next((key for key, kinds in MEANINGS.covers.items() if tags.get(key) in kinds), "")
    return MEANINGS.woods.get(key, {}).get(tags.get(key, ""))


def is_passage(tags: Tags) -> bool:
    """Return whether a road leads through a building."""
    return "highway" in tags and (
        tags.get("tunnel") == "building_passage"
        or tags.get("covered", "no") in {"yes", "arcade", "colonnade"}
    )


def is_hidden(tags: Tags) -> bool:
    """Return whether an object lies under the ground or indoors, out of sight and reach."""
    if is_passage(tags):
        return False
    below = tags.get("layer", "0").startswith("-") or tags.get("location") == "underground"
    return below or tags.get("tunnel", "no") != "no" or tags.get("indoor", "no") != "no"


def metres(text: str | None) -> float | None:
    """Parse an OpenStreetMap length (12, 12.5 m, 12,5, 40 ft, 12'6"); None if invalid."""
    found = re.fullmatch(
        r"\s*(\d+(?:[.,]\d+)?)\s*(m|ft|')?\s*(?:(\d+)\s*(?:\"|in))?\s*", text or ""
    )
    if found is None or (found[3] and found[2] not in _FEET):
        return None
    value = float(found[1].replace(",", ".")) + float(found[3] or 0.0) / 12.0
    return value * 0.3048 if found[2] in _FEET else value


def colour(text: str | None) -> Rgb | None:
    """Parse a colour: "#rgb", "#rrggbb" or a name with optional "light" or "dark"; else None."""
    text = text or ""
    if re.fullmatch(r"#[0-9a-fA-F]{3}", text):
        text = "#" + "".join(2 * digit for digit in text[1:])
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    name = text.lower().replace("_", "").replace(" ", "")
    shade = next((shade for shade in ("light", "dark") if name.startswith(shade)), "")
    plain = MEANINGS.colours.get(name.removeprefix(shade))
    if name in MEANINGS.colours or plain is None:
        return MEANINGS.colours.get(name)
    red, green, blue = (
        (value + 255) // 2 if shade == "light" else value * 2 // 3 for value in plain
    )
    return red, green, blue
