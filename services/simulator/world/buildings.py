"""From outlines with tags to buildings: storeys, wall material, colour, roof, and the parts of a building."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import shapely
from shapely import Polygon, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world.osm import Tags
from services.simulator.world.place import Rgb
from services.simulator.world.tags import colour, metres
from services.simulator.world.terrain import Building, Facade, FacadeStyle, RoofShape, plan

SMALLEST_M2: Final = 4.0
# A part belongs to the building that holds most of it, and parts stand for a building of which they cover most.
_WITHIN: Final = 0.5
_COVERED: Final = 0.7
# Of the look of a building, which its parts share unless they say otherwise.
_SHARED: Final = ("building", "building:material", "building:colour", "smal:facade")
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
_LOW: Final = frozenset({"house", "detached", "garage", "garages", "shed", "roof", "hut"})
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


@dataclass(frozen=True, eq=False)
class Outline:
    """The ground plan of a building, or of a part of one: its id picks how it looks."""

    id: int
    polygons: tuple[Polygon, ...]
    tags: Tags

    @property
    def shape(self) -> BaseGeometry:
        """All of it."""
        return shapely.union_all(self.polygons)


class Composition(NamedTuple):
    """What buildings and their parts come to; `unused` counts the parts that are not drawn, by reason."""

    buildings: tuple[Building, ...]
    parts_used: int
    unused: dict[str, int]


def compose(outlines: Sequence[Outline], parts: Sequence[Outline]) -> Composition:
    """Return all buildings; those whose parts cover at least 70 % of them are drawn as these parts."""
    shapes = [outline.shape for outline in outlines]
    of_building, astray = _assigned(shapes, parts)
    found: list[Building] = []
    used = few = 0
    for shape, outline, own in zip(shapes, outlines, of_building, strict=True):
        covered = shapely.union_all([part.shape for part in own])
        if own and shape.intersection(covered).area >= _COVERED * shape.area:
            used += len(own)
            shared = {key: outline.tags[key] for key in _SHARED if key in outline.tags}
            for part in own:
                found += _buildings(outline.id, part.polygons, shared | dict(part.tags))
        else:
            few += len(own)
            found += _buildings(outline.id, outline.polygons, outline.tags)
    unused = {"they cover too little of their building": few, "it is in no building": astray}
    return Composition(tuple(found), used, {reason: count for reason, count in unused.items() if count})


def _assigned(shapes: Sequence[BaseGeometry], parts: Sequence[Outline]) -> tuple[list[list[Outline]], int]:
    """Return the parts of each building, and how many are of none."""
    tree = STRtree(list(shapes))
    of_building: list[list[Outline]] = [[] for _ in shapes]
    astray = 0
    for part in parts:
        shape = part.shape
        within = [(shapes[hit].intersection(shape).area, int(hit)) for hit in tree.query(shape, "intersects")]
        area, index = max(within, default=(0.0, 0))
        if area >= _WITHIN * shape.area:
            of_building[index].append(part)
        else:
            astray += 1
    return of_building, astray


def _buildings(number: int, polygons: Iterable[Polygon], tags: Tags) -> Iterator[Building]:
    """Yield the pieces of a building that are large enough to draw."""
    for polygon in polygons:
        if polygon.area < SMALLEST_M2:
            continue
        roof, roof_height_m = _roof(tags, polygon)
        height_m = _height_m(tags)
        yield Building(
            **plan(polygon),
            height_m=height_m,
            min_height_m=_min_height_m(tags, height_m),
            roof=roof,
            roof_height_m=roof_height_m,
            roof_colour=colour(tags.get("roof:colour")) or _ROOF_MATERIALS.get(tags.get("roof:material", "")),
            facade=_facade(tags, number),
        )


def _height_m(tags: Tags) -> float:
    """Return the height of a building's eaves in metres: its `height`, else 3 m a level, else what its use suggests.

    OpenStreetMap's `height` is that of the ridge, so a stated height of the roof is taken off; where none is stated,
    the walls are taken to be as high as the map says.
    """
    total, use = metres(tags.get("height")), tags.get("building")
    if total is not None:
        height_m = total - min(_stated_roof_m(tags) or 0.0, total / 2)
    elif levels := metres(tags.get("building:levels")):
        height_m = levels * _STOREY_M
    elif use in _OPEN_BELOW:
        height_m = _CANOPY_M
    else:
        height_m = (2 if use in _LOW else 3) * _STOREY_M
    return min(max(height_m, _LOWEST_M), _TALLEST_M)


def _min_height_m(tags: Tags, top_m: float) -> float:
    """Return where a building's walls begin: its `min_height`, else 3 m a level below it; a canopy is a thin slab."""
    stated, levels = metres(tags.get("min_height")), metres(tags.get("building:min_level"))
    highest_m = top_m - _SLAB_M
    if stated is not None:
        return min(stated, highest_m)
    if levels is not None:
        return min(levels * _STOREY_M, highest_m)
    return highest_m if tags.get("building", tags.get("building:part")) in _OPEN_BELOW else 0.0


def _facade(tags: Tags, number: int) -> Facade:
    """Return the look of a building's walls.

    Buildings with the same `smal:facade` and the same style and colour look identical, which is how a world makes
    places alike on purpose. Without that tag the element's number picks one of a few looks, so that neighbours differ.
    """
    named = tags.get("smal:facade")
    variant = zlib.crc32(named.encode()) % 997 if named else number % _VARIANTS
    choices = _STYLES_OF_USE.get(tags.get("building", ""), _ANY_STYLE)
    # A stable mix of the number, since neighbours often have consecutive ones.
    usual = choices[zlib.crc32(str(number).encode()) % len(choices)]
    style = _STYLE_OF_MATERIAL.get(tags.get("building:material", ""), usual)
    return Facade(style, colour(tags.get("building:colour")), variant)


def _roof(tags: Tags, footprint: Polygon) -> tuple[RoofShape, float]:
    """Return the roof to draw, and how far its ridge is above the eaves in metres (0 for a flat one).

    Shapes that we cannot draw get the nearest one. A house that says nothing has a gabled roof if its footprint is
    about a rectangle, every other building a flat one.
    """
    box = shapely.oriented_envelope(footprint)
    if "roof:shape" in tags:
        shape = _ROOFS.get(tags["roof:shape"], "flat")
    else:
        house = tags.get("building") in _HOUSES and "building:part" not in tags and not footprint.interiors
        shape = "gabled" if house and footprint.area > _ABOUT_A_RECTANGLE * box.area else "flat"
    if shape == "flat":
        return "flat", 0.0
    height = _stated_roof_m(tags)
    if height is None:
        corners = shapely.get_coordinates(box)
        half_width = float(min(math.dist(corners[0], corners[1]), math.dist(corners[1], corners[2]))) / 2
        angle = metres((tags.get("roof:angle") or "").removesuffix("°"))
        slope = math.tan(math.radians(min(angle, _STEEPEST_DEG))) if angle else _ROOF_SLOPE
        height = (half_width + _OVERHANG_M) * slope
    return shape, min(max(height, _LOWEST_ROOF_M), _HIGHEST_ROOF_M)


def _stated_roof_m(tags: Tags) -> float | None:
    """Return the height of a pitched roof, where its height or its levels are stated."""
    if _ROOFS.get(tags.get("roof:shape", ""), "flat") == "flat":
        return None
    levels = metres(tags.get("roof:levels"))
    return metres(tags.get("roof:height")) or (levels * _ROOF_STOREY_M if levels else None)
