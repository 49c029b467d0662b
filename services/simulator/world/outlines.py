"""From lines of points to areas: closed ways, and the rings of multipolygon relations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, MultiPolygon, Polygon, STRtree
from shapely.geometry.base import BaseGeometry

_OPEN: Final = "its outline is not closed"
_TANGLED: Final = "it crosses itself too often"
_BROKEN_RINGS: Final = "its rings do not close or cross each other"
# Untangling an outline costs more than the square of its crossings: 300 random corners take 13 s.
_MOST_CROSSINGS: Final = 50
_MOST_NEAR_PAIRS_A_SEGMENT: Final = 40


class OutlineError(ValueError):
    """Points do not enclose an area; the message says why and follows the name of what they belong to."""


def area_within(points: NDArray[np.float64]) -> BaseGeometry:
    """Return the area that a closed line (n, 2) encloses, untangled where it crosses itself.

    An `OutlineError` says that the line is open, encloses nothing, or crosses itself too often.
    """
    if len(points) < 4 or (points[0] != points[-1]).any():
        raise OutlineError(_OPEN)
    area: BaseGeometry = Polygon(points)
    if not area.is_valid:
        if _is_tangled(points):
            raise OutlineError(_TANGLED)
        area = shapely.make_valid(area)
    return _only_areas(area)


def area_of_rings(outer: Sequence[LineString], inner: Sequence[LineString]) -> BaseGeometry:
    """Return the area of a multipolygon relation, given its members' lines in any order and direction.

    A ring inside another one of the same role is a hole in it, as where roles were forgotten. An `OutlineError` says
    that the lines do not join to closed rings, that rings cross, or that nothing is enclosed.
    """
    shells, holes = _faces(outer), _faces(inner)
    if not shells:
        raise OutlineError(_OPEN)
    _, overlapping = STRtree(shells + holes).query(shells + holes, "overlaps")
    if len(overlapping):
        raise OutlineError(_BROKEN_RINGS)
    # Faces of nested rings exclude each other, so that every other one, from outside inwards, is part of the area.
    area = shapely.build_area(shapely.GeometryCollection(list(outer)))
    if holes:
        area = area.difference(shapely.union_all(holes))
    if not area.is_valid:
        raise OutlineError(_BROKEN_RINGS)
    return _only_areas(area)


def line_through(points: NDArray[np.float64]) -> LineString:
    """Return the line along points (n, 2); an `OutlineError` where it has no length, or crosses itself too often."""
    line = LineString(points)
    if line.length == 0:
        raise OutlineError("it has no length")
    if not line.is_simple and _is_tangled(points):
        raise OutlineError(_TANGLED)
    return line


def polygons_in(area: BaseGeometry, frame: Polygon) -> list[Polygon]:
    """Return the parts of a valid area that lie inside the frame; touching it is not enough."""
    return [part for part in shapely.get_parts(area.intersection(frame)) if isinstance(part, Polygon) and part.area > 0]


def lines_in(line: LineString, frame: Polygon) -> list[LineString]:
    """Return the parts of a line that lie inside the frame; where it crosses itself, it is not cut."""
    parts = shapely.get_parts(shapely.clip_by_rect(line, *frame.bounds))
    return [part for part in parts if part.geom_type == "LineString" and part.length > 0]


def _faces(lines: Sequence[LineString]) -> list[BaseGeometry]:
    """Return what closed rings of the lines enclose, each face without the faces inside it."""
    if not lines:
        return []
    faces, *left_over = shapely.polygonize_full(list(lines))
    if not all(rest.is_empty for rest in left_over):
        raise OutlineError(_BROKEN_RINGS)
    return list(shapely.get_parts(faces))


def _is_tangled(points: NDArray[np.float64]) -> bool:
    segments = np.asarray(shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
    tree = STRtree(segments)
    if tree.query(segments).shape[1] > _MOST_NEAR_PAIRS_A_SEGMENT * len(segments):
        return True
    return bool(tree.query(segments, "crosses").shape[1] > 2 * _MOST_CROSSINGS)


def _only_areas(geometry: BaseGeometry) -> BaseGeometry:
    # What remains of an outline that crosses itself may be a collection of collections.
    every = [inner for part in shapely.get_parts(geometry) for inner in shapely.get_parts(part)]
    parts = [part for part in every if isinstance(part, Polygon) and part.area > 0]
    if not parts:
        raise OutlineError("its outline encloses nothing")
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)
