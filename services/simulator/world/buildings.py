"""Convert tagged outlines to buildings: height, wall material, colour, roof, parts."""

import math
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import shapely
from shapely import Polygon, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world.osm import Tags
from services.simulator.world.tags import MEANINGS, colour, metres
from services.simulator.world.terrain import Building, Facade, RoofShape, plan

SMALLEST_M2: Final = 4.0
# A part belongs to the building that contains most of it; parts replace a mostly covered building.
_WITHIN: Final = 0.5
_COVERED: Final = 0.7
# Tags of appearance that parts inherit from their building.
_SHARED: Final = ("building", "building:material", "building:colour", "smal:facade")
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
# Most mapped buildings have no tags of appearance; this many variants of a style separate
# neighbours.
_VARIANTS: Final = 8


class Outline(NamedTuple):
    """Footprint of a building or part; its id selects the appearance."""

    id: int
    shape: BaseGeometry
    tags: Tags


def compose(
    outlines: Sequence[Outline], parts: Sequence[Outline]
) -> tuple[list[Building], Counter[str]]:
    """Compose buildings, replacing those that parts cover to 70 % by their parts.

    Returns
    -------
    buildings : list of Building
    counts : Counter
        Number of "used" parts, and of unused parts by reason.
    """
    own = _by_outline(outlines, parts)
    counts = Counter({"it is in no building": len(parts) - sum(map(len, own))})
    found: list[Building] = []
    for outline, mine in zip(outlines, own, strict=True):
        covered = shapely.union_all([part.shape for part in mine])
        if mine and outline.shape.intersection(covered).area >= _COVERED * outline.shape.area:
            counts["used"] += len(mine)
            shared = {key: outline.tags[key] for key in _SHARED if key in outline.tags}
            for part in mine:
                found += _buildings(outline.id, part.shape, shared | dict(part.tags))
        else:
            counts["they cover too little of their building"] += len(mine)
            found += _buildings(outline.id, outline.shape, outline.tags)
    return found, +counts


def _by_outline(outlines: Sequence[Outline], parts: Sequence[Outline]) -> list[list[Outline]]:
    tree = STRtree([outline.shape for outline in outlines])
    own: list[list[Outline]] = [[] for _ in outlines]
    for part in parts:
        hits = tree.query(part.shape, "intersects")
        within = [(outlines[hit].shape.intersection(part.shape).area, int(hit)) for hit in hits]
        area, index = max(within, default=(0.0, 0))
        if area >= _WITHIN * part.shape.area:
            own[index].append(part)
    return own


def _buildings(number: int, shape: BaseGeometry, tags: Tags) -> Iterator[Building]:
    for polygon in shapely.get_parts(shape):
        if polygon.area < SMALLEST_M2:
            continue
        roof, roof_height_m = _roof(tags, polygon)
        height_m = _height_m(tags)
        material = MEANINGS.roof_materials.get(tags.get("roof:material", ""))
        yield Building(
            **plan(polygon),
            height_m=height_m,
            min_height_m=_min_height_m(tags, height_m),
            roof=roof,
            roof_height_m=roof_height_m,
            roof_colour=colour(tags.get("roof:colour")) or material,
            facade=_facade(tags, number),
        )


def _height_m(tags: Tags) -> float:
    """Return the height of the eaves, metres: from `height`, else 3 m a level, else from the use.

    OpenStreetMap's `height` includes the roof, so a stated roof height is subtracted. Without one
    the walls take the whole height.
    """
    total = metres(tags.get("height"))
    use = tags.get("building")
    if total is not None:
        height_m = total - min(_stated_roof_m(tags) or 0.0, total / 2)
    elif levels := metres(tags.get("building:levels")):
        height_m = levels * _STOREY_M
    elif use in MEANINGS.open_below:
        height_m = _CANOPY_M
    else:
        height_m = (2 if use in MEANINGS.low else 3) * _STOREY_M
    return min(max(height_m, _LOWEST_M), _TALLEST_M)


def _min_height_m(tags: Tags, top_m: float) -> float:
    """Return the lower end of walls: `min_height`, else 3 m a level; a canopy is a thin slab."""
    stated = metres(tags.get("min_height"))
    levels = metres(tags.get("building:min_level"))
    highest_m = top_m - _SLAB_M
    if stated is not None:
        return min(stated, highest_m)
    if levels is not None:
        return min(levels * _STOREY_M, highest_m)
    return (
        highest_m if tags.get("building", tags.get("building:part")) in MEANINGS.open_below else 0.0
    )


def _facade(tags: Tags, number: int) -> Facade:
    """Return the appearance of a building's walls.

    Buildings with equal `smal:facade`, style and colour look identical, which makes places
    ambiguous on purpose. Without that tag the element's id selects one of a few variants.
    """
    named = tags.get("smal:facade")
    variant = zlib.crc32(named.encode()) % 997 if named else number % _VARIANTS
    choices = MEANINGS.styles_of_use.get(tags.get("building", ""), MEANINGS.any_style)
    # Hash the id, since neighbours often have consecutive ids.
    usual = choices[zlib.crc32(str(number).encode()) % len(choices)]
    style = MEANINGS.style_of_material.get(tags.get("building:material", ""), usual)
    return Facade(style, colour(tags.get("building:colour")), variant)


def _roof(tags: Tags, footprint: Polygon) -> tuple[RoofShape, float]:
    """Return the roof shape and the height of its ridge above the eaves, metres (0 if flat).

    Unsupported shapes become the nearest supported shape. By default nearly rectangular houses have
    a gabled roof, and other buildings a flat roof.
    """
    box = shapely.oriented_envelope(footprint)
    if "roof:shape" in tags:
        shape = MEANINGS.roofs.get(tags["roof:shape"], "flat")
    else:
        house = (
            tags.get("building") in MEANINGS.houses
            and "building:part" not in tags
            and not footprint.interiors
        )
        shape = "gabled" if house and footprint.area > _ABOUT_A_RECTANGLE * box.area else "flat"
    if shape == "flat":
        return "flat", 0.0
    height = _stated_roof_m(tags)
    if height is None:
        corners = shapely.get_coordinates(box)
        half_width = (
            float(min(math.dist(corners[0], corners[1]), math.dist(corners[1], corners[2]))) / 2
        )
        angle = metres((tags.get("roof:angle") or "").removesuffix("°"))
        slope = math.tan(math.radians(min(angle, _STEEPEST_DEG))) if angle else _ROOF_SLOPE
        height = (half_width + _OVERHANG_M) * slope
    return shape, min(max(height, _LOWEST_ROOF_M), _HIGHEST_ROOF_M)


def _stated_roof_m(tags: Tags) -> float | None:
    if MEANINGS.roofs.get(tags.get("roof:shape", ""), "flat") == "flat":
        return None
    levels = metres(tags.get("roof:levels"))
    return metres(tags.get("roof:height")) or (levels * _ROOF_STOREY_M if levels else None)
