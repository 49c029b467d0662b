"""From outlines with tags to buildings, and from buildings in parts to their parts."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import shapely
from shapely import STRtree

from services.simulator.world import looks
from services.simulator.world.terrain import Building

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from shapely import Polygon
    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.kinds import Tags

SMALLEST_M2: Final = 4.0
# A part belongs to the building that holds most of it, and parts stand for a building of which they cover most.
_WITHIN: Final = 0.5
_COVERED: Final = 0.7
# Of the look of a building, which its parts share unless they say otherwise.
_SHARED: Final = ("building", "building:material", "building:colour", "smal:facade")


@dataclass(frozen=True, eq=False)
class Outline:
    """The ground plan of a building, or of a part of one: its id picks how it looks."""

    id: int
    polygons: tuple[Polygon, ...]
    tags: Tags


def buildings_of(outline: Outline) -> list[Building]:
    """Return the pieces of a building that are large enough to draw."""
    return [_building(polygon, outline.id, outline.tags) for polygon in outline.polygons if polygon.area >= SMALLEST_M2]


@dataclass(frozen=True)
class Composition:
    """What buildings and their parts come to.

    Attributes
    ----------
    unused
        How many parts there are, by the reason why they are not drawn.
    """

    buildings: tuple[Building, ...]
    parts_used: int
    unused: Mapping[str, int]


def compose(outlines: Sequence[Outline], parts: Sequence[Outline]) -> Composition:
    """Return all buildings; those whose parts cover at least 70 % of them are drawn as these parts."""
    shapes = [shapely.union_all(outline.polygons) for outline in outlines]
    of_building, astray = _assigned(shapes, parts)
    found: list[Building] = []
    used = few = 0
    for index, outline in enumerate(outlines):
        own = of_building.get(index, [])
        covered = shapely.union_all([polygon for part in own for polygon in part.polygons])
        if own and shapes[index].intersection(covered).area >= _COVERED * shapes[index].area:
            used += len(own)
            for part in own:
                found += buildings_of(Outline(outline.id, part.polygons, _inherited(part.tags, outline.tags)))
        else:
            few += len(own)
            found += buildings_of(outline)
    unused = {"they cover too little of their building": few, "it is in no building": astray}
    return Composition(tuple(found), used, {reason: count for reason, count in unused.items() if count})


def _assigned(shapes: Sequence[BaseGeometry], parts: Sequence[Outline]) -> tuple[Mapping[int, list[Outline]], int]:
    """Return the parts of each building, by its place in the list, and how many are of none."""
    tree = STRtree(list(shapes))
    of_building: dict[int, list[Outline]] = defaultdict(list)
    astray = 0
    for part in parts:
        shape = shapely.union_all(part.polygons)
        within = [(shapes[hit].intersection(shape).area, int(hit)) for hit in tree.query(shape, "intersects")]
        area, index = max(within, default=(0.0, 0))
        if area >= _WITHIN * shape.area:
            of_building[index].append(part)
        else:
            astray += 1
    return of_building, astray


def _inherited(part: Tags, whole: Tags) -> Tags:
    return {key: whole[key] for key in _SHARED if key in whole} | dict(part)


def _building(polygon: Polygon, element_id: int, tags: Tags) -> Building:
    roof, roof_height_m = looks.roof(tags, polygon)
    return Building(
        footprint=polygon,
        height_m=looks.height_m(tags),
        facade=looks.facade(tags, element_id),
        roof=roof,
        min_height_m=looks.min_height_m(tags),
        roof_height_m=roof_height_m,
        roof_colour=looks.roof_colour(tags),
    )
