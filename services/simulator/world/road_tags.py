"""From the tags of a highway to a road: how wide it is, what is painted on it, who walks beside it."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from shapely import LineString, Polygon

from services.simulator.world import looks
from services.simulator.world.kinds import PATH_WIDTH_M, STREET_WIDTH_M, Tags
from services.simulator.world.terrain import Road

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_NOT_FOR_A_ROBOT: Final = frozenset({"motorway", "motorway_link", "trunk", "trunk_link", "steps"})
_MARKED: Final = frozenset({"primary", "secondary", "tertiary", "residential"})
_LANE_M: Final = 3.2
_NARROWEST_M: Final = 1.0
_WIDEST_M: Final = 40.0
_MOST_LANES: Final = 10
# A way across a square is a line to plan along on ground that is paved already.
_ACROSS_M: Final = 0.2
_MOST_ENTRIES: Final = 12


def road(line: LineString, tags: Tags) -> Road:
    """Return the road of a line with a known `highway`."""
    highway = tags["highway"]
    return Road(
        line=line,
        width_m=width_m(tags),
        kind="street" if highway in STREET_WIDTH_M else "path",
        drivable=highway not in _NOT_FOR_A_ROBOT,
        marked=_is_marked(tags),
        sidewalks=_has_sidewalks(tags),
    )


def width_m(tags: Tags) -> float:
    """Return a road's width in metres: as stated, else of its lanes, else what is usual for its class."""
    highway = tags["highway"]
    stated = looks.metres(tags.get("width")) or looks.metres(tags.get("est_width"))
    if stated is None and highway in STREET_WIDTH_M:
        lanes = _lanes(tags)
        stated = lanes * _LANE_M if lanes else None
    usual = STREET_WIDTH_M.get(highway) or PATH_WIDTH_M[highway]
    return min(max(stated or usual, _NARROWEST_M), _WIDEST_M)


def across_squares(squares: Iterable[Polygon], roads: Iterable[Road]) -> Iterator[Road]:
    """Yield ways straight across paved squares, between the points where drivable roads reach their outlines."""
    drivable = [shapely.get_coordinates(road.line) for road in roads if road.drivable]
    points = np.unique(np.round(np.concatenate(drivable), 2), axis=0) if drivable else np.empty((0, 2))
    reached = shapely.STRtree(np.asarray(shapely.points(points)))
    for square in squares:
        near = reached.query(square.exterior, "dwithin", 0.02)
        entries = points[np.sort(near)][:_MOST_ENTRIES]
        inside = square.buffer(0.05)
        for first, second in itertools.combinations(entries, 2):
            line = LineString([first, second])
            if line.length > 0 and inside.contains(line):
                yield Road(line, _ACROSS_M, "path", drivable=True, marked=False)


def _lanes(tags: Tags) -> int | None:
    text = tags.get("lanes", "")
    return min(int(text), _MOST_LANES) if text.isdecimal() and text.isascii() and len(text) < 4 and int(text) else None


def _is_marked(tags: Tags) -> bool:
    one_lane = (_lanes(tags) or 2) < 2
    return tags["highway"] in _MARKED and tags.get("lane_markings") != "no" and not one_lane


def _has_sidewalks(tags: Tags) -> bool:
    """Return whether there is a sidewalk on a side; one that the map draws by itself is none of the road's."""
    sides = [tags[key] for key in ("sidewalk:both", "sidewalk:left", "sidewalk:right") if key in tags]
    stated = tags.get("sidewalk")
    if stated is not None:
        return stated in {"both", "left", "right", "yes"}
    if sides:
        return "yes" in sides
    return tags["highway"] in _MARKED
