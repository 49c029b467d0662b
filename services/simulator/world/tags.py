"""What OpenStreetMap's tags stand for: which kind of thing an element is, how long, how wide and of which colour."""

from __future__ import annotations

import re
from typing import Final, Literal, NamedTuple

from services.simulator.world.osm import Tags
from services.simulator.world.place import Rgb
from services.simulator.world.terrain import AreaKind, BarrierKind

Kind = Literal["building", "building part", "road", "square", "area", "wood", "waterway", "barrier", "row", "tree"]


class Cover(NamedTuple):
    """What covers an area of the ground, and whether trees stand on it."""

    kind: AreaKind
    tree_m: float | None = None


STREET_WIDTH_M: Final = {
    "motorway": 12.0, "motorway_link": 6.0, "trunk": 11.0, "trunk_link": 6.0, "primary": 10.0, "primary_link": 6.0,
    "secondary": 9.0, "secondary_link": 6.0, "tertiary": 8.0, "tertiary_link": 6.0, "residential": 7.0,
    "unclassified": 6.5, "road": 6.0, "living_street": 5.0, "service": 4.5, "busway": 4.5, "track": 3.0,
}  # fmt: skip
PATH_WIDTH_M: Final = {
    "pedestrian": 4.0, "footway": 2.4, "cycleway": 2.6, "path": 2.0, "bridleway": 2.0, "steps": 2.0,
}  # fmt: skip
WATERWAY_WIDTH_M: Final = {"river": 8.0, "canal": 6.0, "stream": 1.5, "ditch": 1.0, "drain": 1.0, "brook": 1.5}
BARRIERS: Final[dict[str, tuple[BarrierKind, float]]] = {
    "hedge": ("hedge", 1.6), "wall": ("wall", 2.0), "retaining_wall": ("wall", 1.2), "fence": ("fence", 1.3),
    "city_wall": ("wall", 5.0), "guard_rail": ("fence", 0.8), "handrail": ("fence", 1.0),
    "jersey_barrier": ("wall", 0.9), "railing": ("fence", 1.0),
}  # fmt: skip
#: Nodes that open the barrier on which they lie.
GATES: Final = frozenset({
    "gate", "entrance", "lift_gate", "swing_gate", "kissing_gate", "sliding_gate", "wicket_gate", "hampshire_gate",
    "stile", "turnstile", "bollard", "cycle_barrier", "cattle_grid", "toll_booth", "sally_port",
})  # fmt: skip
_COVERS: Final[dict[str, dict[str, Cover]]] = {
    "natural": {
        "water": Cover("water"), "grassland": Cover("grass"), "wood": Cover("grass", 0.0),
        "scrub": Cover("grass", 2.2), "heath": Cover("grass"), "wetland": Cover("grass"), "bay": Cover("water"),
    },
    "landuse": {
        "grass": Cover("grass"), "meadow": Cover("grass"), "recreation_ground": Cover("grass"),
        "village_green": Cover("grass"), "forest": Cover("grass", 0.0), "orchard": Cover("grass", 4.0),
        "cemetery": Cover("grass"), "allotments": Cover("grass"), "flowerbed": Cover("grass"),
        "greenfield": Cover("grass"), "farmland": Cover("grass"), "vineyard": Cover("grass"),
        "reservoir": Cover("water"), "basin": Cover("water"),
    },
    "leisure": {
        "park": Cover("grass"), "garden": Cover("grass"), "pitch": Cover("grass"), "golf_course": Cover("grass"),
        "dog_park": Cover("grass"), "playground": Cover("grass"), "recreation_ground": Cover("grass"),
        "swimming_pool": Cover("water"),
    },
    "waterway": {"riverbank": Cover("water"), "dock": Cover("water")},
    "amenity": {"parking": Cover("paved"), "fountain": Cover("water"), "grave_yard": Cover("grass")},
    "place": {"square": Cover("paved")},
    "public_transport": {"platform": Cover("paved")},
    "railway": {"platform": Cover("paved")},
}  # fmt: skip
_COLOURS: Final[dict[str, Rgb]] = {
    "white": (232, 230, 224), "grey": (150, 150, 148), "gray": (150, 150, 148), "black": (60, 60, 62),
    "red": (168, 72, 58), "maroon": (120, 52, 46), "brown": (126, 92, 66), "beige": (216, 200, 168),
    "yellow": (222, 192, 110), "orange": (206, 134, 78), "green": (122, 146, 110), "olive": (128, 128, 84),
    "silver": (182, 184, 186), "tan": (196, 168, 130), "sandybrown": (214, 170, 118), "darkred": (120, 52, 46),
    "blue": (112, 138, 172), "teal": (96, 140, 140), "pink": (214, 168, 160), "cream": (234, 222, 192),
}  # fmt: skip
_HARD: Final = frozenset({"asphalt", "concrete", "paving_stones", "paved", "sett", "concrete:plates", "bricks"})
_BELOW_GROUND: Final = frozenset({"underground", "multi-storey", "rooftop"})


def kinds_of(tags: Tags) -> list[Kind]:
    """Return what a way or relation stands for, of the things that a terrain has; most stand for one or none."""
    if tags.get("building", "no") != "no":
        return ["building"]
    if tags.get("building:part", "no") != "no":
        return ["building part"]
    found: list[Kind] = []
    highway = tags.get("highway", "")
    if highway in STREET_WIDTH_M or highway in PATH_WIDTH_M:
        found.append("square" if is_area(tags) else "road")
    if tags.get("barrier") in BARRIERS:
        found.append("barrier")
    if tags.get("natural") == "tree_row":
        found.append("row")
    if tags.get("waterway") in WATERWAY_WIDTH_M:
        found.append("waterway")
    cover = cover_of(tags)
    if cover is not None and "square" not in found:
        found.append("area" if cover.tree_m is None else "wood")
    return found


def cover_of(tags: Tags) -> Cover | None:
    """Return what covers an area with these tags, or None where they do not say."""
    if tags.get("parking") in _BELOW_GROUND:
        return None
    cover = next((covers[tags[key]] for key, covers in _COVERS.items() if tags.get(key) in covers), None)
    if cover == Cover("grass") and tags.get("surface") in _HARD:
        return Cover("paved")
    return cover


def is_area(tags: Tags) -> bool:
    """Return whether a highway is paved ground between its outlines, and no line."""
    return tags.get("area") == "yes" or tags.get("type") == "multipolygon"


def is_passage(tags: Tags) -> bool:
    """Return whether a road leads through a building."""
    return "highway" in tags and (
        tags.get("tunnel") == "building_passage" or tags.get("covered", "no") in {"yes", "arcade", "colonnade"}
    )


def is_hidden(tags: Tags) -> bool:
    """Return whether something lies under the ground or inside a building, where nobody would see or reach it."""
    if is_passage(tags):
        return False
    below = tags.get("layer", "0").startswith("-") or tags.get("location") == "underground"
    return below or tags.get("tunnel", "no") != "no" or tags.get("indoor", "no") != "no"


def metres(text: str | None) -> float | None:
    """Read an OpenStreetMap length: "12", "12.5 m", "12,5" or "40'" (feet); None where there is none to read."""
    found = re.fullmatch(r"\s*(\d+(?:[.,]\d+)?)\s*(m|ft|')?\s*", text or "")
    if found is None:
        return None
    value = float(found[1].replace(",", "."))
    return value * 0.3048 if found[2] in {"ft", "'"} else value


def colour(text: str | None) -> Rgb | None:
    """Read an OpenStreetMap colour: "#rgb", "#rrggbb" or a name, perhaps "light" or "dark"; else None."""
    text = text or ""
    if re.fullmatch(r"#[0-9a-fA-F]{3}", text):
        text = "#" + "".join(2 * digit for digit in text[1:])
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    name = text.lower().replace("_", "").replace(" ", "")
    shade = next((shade for shade in ("light", "dark") if name.startswith(shade)), "")
    plain = _COLOURS.get(name.removeprefix(shade))
    if name in _COLOURS or plain is None:
        return _COLOURS.get(name)
    red, green, blue = ((value + 255) // 2 if shade == "light" else value * 2 // 3 for value in plain)
    return red, green, blue
