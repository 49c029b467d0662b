"""Convert highway tags to roads, and open solid things where roads cross them."""

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import shapely
from shapely import LineString, Polygon, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world.osm import Tags
from services.simulator.world.place import polygons
from services.simulator.world.tags import MEANINGS, metres
from services.simulator.world.terrain import Area, Barrier, Building, Road, plan

_LANE_M: Final = 3.2
_NARROWEST_M: Final = 1.0
_WIDEST_M: Final = 40.0
_MOST_LANES: Final = 10
# Paths across a square are for planning only, since the ground is already paved.
_ACROSS_M: Final = 0.2
_MOST_ENTRIES: Final = 12
# Margin on either side of a road, which keeps the clearance of a robot in its middle.
_MARGIN_M: Final = 0.8
_NARROWEST_GAP_M: Final = 2.0
_GATE_M: Final = 1.6
PASSAGE_M: Final = 3.2  # Clear height of a passage through a building, enough for a car.
_THINNEST_STOREY_M: Final = 0.8
# Smaller remains of cutting are dropped.
_SMALLEST_M2: Final = 0.5
_SHORTEST_M: Final = 0.3


def road(line: LineString, tags: Tags) -> Road:
    """Convert a line with a known `highway` to a road; width from tags, lanes or class."""
    highway = tags["highway"]
    lanes = 0
    if re.fullmatch("[0-9]{1,3}", tags.get("lanes", "")):
        lanes = min(int(tags["lanes"]), _MOST_LANES)
    width_m = metres(tags.get("width")) or metres(tags.get("est_width"))
    if width_m is None and highway in MEANINGS.street_width_m and lanes:
        width_m = lanes * _LANE_M
    width_m = width_m or MEANINGS.street_width_m.get(highway) or MEANINGS.path_width_m[highway]
    return Road(
        line=line,
        width_m=min(max(width_m, _NARROWEST_M), _WIDEST_M),
        kind="street" if highway in MEANINGS.street_width_m else "path",
        drivable=highway not in MEANINGS.not_for_a_robot,
        marked=highway in MEANINGS.marked and tags.get("lane_markings") != "no" and lanes != 1,
        sidewalks=_has_sidewalks(tags),
    )


def _has_sidewalks(tags: Tags) -> bool:
    """Return whether a road has sidewalks; separately mapped sidewalks do not count."""
    sides = [
        tags[key] for key in ("sidewalk:both", "sidewalk:left", "sidewalk:right") if key in tags
    ]
    if "sidewalk" in tags:
        return tags["sidewalk"] in {"both", "left", "right", "yes"}
    return "yes" in sides if sides else tags["highway"] in MEANINGS.marked


def across_squares(squares: Iterable[Polygon], roads: Iterable[Road]) -> Iterator[Road]:
    """Yield straight paths across squares, between the ends of drivable roads at their outlines."""
    drivable = [shapely.get_coordinates(road.line) for road in roads if road.drivable]
    points = (
        np.unique(np.round(np.concatenate(drivable), 2), axis=0) if drivable else np.empty((0, 2))
    )
    reached = shapely.STRtree(np.asarray(shapely.points(points)))
    for square in squares:
        near = reached.query(square.exterior, "dwithin", 0.02)
        entries = points[np.sort(near)][:_MOST_ENTRIES]
        inside = square.buffer(0.05)
        for first, second in itertools.combinations(entries, 2):
            line = LineString([first, second])
            if line.length > 0 and inside.contains(line):
                yield Road(line, _ACROSS_M, "path", drivable=True, marked=False)


def open_passages(buildings: Iterable[Building], passages: Sequence[Road]) -> Iterator[Building]:
    """Yield the buildings with passages opened to a height of 3.2 m."""
    ways = [_strip(road) for road in passages]
    tree = STRtree(ways)
    for building in buildings:
        hits = (
            tree.query(building.footprint, "intersects")
            if building.min_height_m < PASSAGE_M
            else ()
        )
        if len(hits) == 0:
            yield building
        else:
            yield from _opened(building, shapely.union_all([ways[hit] for hit in hits]))


def bridge_water(areas: Iterable[Area], roads: Iterable[Road]) -> Iterator[Area]:
    """Yield the areas without water under roads, which count as bridges or fords."""
    strips = [_strip(road) for road in roads]
    tree = STRtree(strips)
    for area in areas:
        hits = tree.query(area.footprint, "intersects") if area.kind == "water" else ()
        if len(hits) == 0:
            yield area
        else:
            rest = area.footprint.difference(shapely.union_all([strips[hit] for hit in hits]))
            yield from (replace(area, **plan(part)) for part in polygons(rest, _SMALLEST_M2))


def open_barriers(
    barriers: Iterable[Barrier], roads: Sequence[Road], gates: Sequence[shapely.Point]
) -> Iterator[Barrier]:
    """Yield the barriers, with gaps at roads and gates."""
    tree = STRtree([road.line for road in roads])
    gate_tree = STRtree(list(gates))
    for barrier in barriers:
        gaps = [gates[hit].buffer(_GATE_M) for hit in gate_tree.query(barrier.line, "dwithin", 0.1)]
        crossed = [roads[hit] for hit in tree.query(barrier.line, "intersects")]
        gaps += [
            barrier.line.intersection(road.line).buffer(_half_width_m(road)) for road in crossed
        ]
        if not gaps:
            yield barrier
        else:
            parts = shapely.get_parts(barrier.line.difference(shapely.union_all(gaps)))
            yield from (replace(barrier, line=part) for part in parts if part.length > _SHORTEST_M)


def _opened(building: Building, passage: BaseGeometry) -> Iterator[Building]:
    beside = polygons(building.footprint.difference(passage), _SMALLEST_M2)
    above = polygons(building.footprint.intersection(passage), _SMALLEST_M2)
    if not above:
        yield building
        return
    # A pitched roof over a part would differ from the whole building's roof.
    flat = replace(building, roof="flat", roof_height_m=0.0)
    yield from (replace(flat, **plan(part)) for part in beside)
    if building.height_m >= PASSAGE_M + _THINNEST_STOREY_M:
        yield from (replace(flat, **plan(part), min_height_m=PASSAGE_M) for part in above)


def _strip(road: Road) -> BaseGeometry:
    return road.line.buffer(_half_width_m(road), cap_style="square")


def _half_width_m(road: Road) -> float:
    return max(road.width_m, _NARROWEST_GAP_M) / 2 + _MARGIN_M
