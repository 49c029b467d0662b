"""Where a road meets something solid: passages through buildings, bridges over water, gaps in walls."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import shapely
from shapely import Polygon, STRtree

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.terrain import Area, Barrier, Building, Road

# Beside a road on either side, so that a robot in its middle keeps its clearance from what was cut.
_MARGIN_M: Final = 0.8
_NARROWEST_M: Final = 2.0
_GATE_M: Final = 1.6
#: Under a building over a passage there is room for a car.
PASSAGE_M: Final = 3.2
_THINNEST_STOREY_M: Final = 0.8
# Slivers that cutting leaves behind are not worth drawing.
_SMALLEST_M2: Final = 0.5
_SHORTEST_M: Final = 0.3


def open_passages(buildings: Sequence[Building], passages: Sequence[Road]) -> Iterator[Building]:
    """Yield the buildings, with those that a passage leads through opened up to 3.2 m above it."""
    if not passages:
        yield from buildings
        return
    ways = [_strip(road) for road in passages]
    tree = STRtree(ways)
    for building in buildings:
        hits = tree.query(building.footprint, "intersects")
        if len(hits) == 0 or building.min_height_m >= PASSAGE_M:
            yield building
        else:
            yield from _opened(building, shapely.union_all([ways[hit] for hit in hits]))


def bridge_water(areas: Sequence[Area], roads: Sequence[Road]) -> Iterator[Area]:
    """Yield the areas, with water cut out under roads: they are bridges, or fords, and the robot crosses on them."""
    strips = [_strip(road) for road in roads]
    tree = STRtree(strips)
    for area in areas:
        hits = tree.query(area.polygon, "intersects") if area.kind == "water" else ()
        if len(hits) == 0:
            yield area
            continue
        rest = area.polygon.difference(shapely.union_all([strips[hit] for hit in hits]))
        yield from (replace(area, polygon=part) for part in _polygons(rest))


def open_barriers(
    barriers: Sequence[Barrier], roads: Sequence[Road], gates: Sequence[shapely.Point]
) -> Iterator[Barrier]:
    """Yield the barriers, with gaps where roads cross them and at gates."""
    tree = STRtree([road.line for road in roads])
    gate_tree = STRtree(list(gates))
    for barrier in barriers:
        gaps = [gates[hit].buffer(_GATE_M) for hit in gate_tree.query(barrier.line, "dwithin", 0.1)]
        for hit in tree.query(barrier.line, "intersects"):
            crossing = barrier.line.intersection(roads[hit].line)
            gaps.append(crossing.buffer(_half_width_m(roads[hit])))
        if not gaps:
            yield barrier
            continue
        rest = barrier.line.difference(shapely.union_all(gaps))
        parts = shapely.get_parts(rest)
        yield from (replace(barrier, line=part) for part in parts if part.length > _SHORTEST_M)


def _opened(building: Building, passage: BaseGeometry) -> Iterator[Building]:
    beside = _polygons(building.footprint.difference(passage))
    above = _polygons(building.footprint.intersection(passage))
    if not above:
        yield building
        return
    # A pitched roof over a part of its building would be another roof.
    flat = replace(building, roof="flat", roof_height_m=0.0)
    yield from (replace(flat, footprint=part) for part in beside)
    if building.height_m >= PASSAGE_M + _THINNEST_STOREY_M:
        yield from (replace(flat, footprint=part, min_height_m=PASSAGE_M) for part in above)


def _strip(road: Road) -> BaseGeometry:
    return road.line.buffer(_half_width_m(road), cap_style="square")


def _half_width_m(road: Road) -> float:
    return max(road.width_m, _NARROWEST_M) / 2 + _MARGIN_M


def _polygons(area: BaseGeometry) -> list[Polygon]:
    return [part for part in shapely.get_parts(area) if isinstance(part, Polygon) and part.area > _SMALLEST_M2]
