"""Trees that a map does not show one by one: woods, orchards and rows."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world.terrain import Area, Barrier, Building, Road, Tree, TreeKind

_ROW_M: Final = 8.0
_SPACING_M: Final = 7.5
# Every tree costs time in every picture: larger woods are thinner.
_MOST_SCATTERED: Final = 800
_MOST_IN_ROWS: Final = 2_000
_MOST_TRIED: Final = 500_000
# Of trunks from roads, so that lanes stay free, and of crowns from walls.
_FROM_ROAD_M: Final = 1.6
_FROM_WALL_M: Final = 1.8
#: Kinds of trees with leaves, and how high trees usually are.
BROAD: Final[tuple[TreeKind, TreeKind]] = ("round", "tall")
USUAL_HEIGHT_M: Final[dict[TreeKind, float]] = {"round": 7.0, "tall": 11.0, "conifer": 10.0}


class Wood(NamedTuple):
    """Ground on which trees stand; the number of the map's element seeds where."""

    number: int
    polygon: Polygon
    height_m: float | None  # Of a tree; None for what is usual for its kind.
    leaf_type: str  # As OpenStreetMap has it: "broadleaved", "needleleaved", else mixed.


class Row(NamedTuple):
    """A line of trees."""

    number: int
    line: LineString
    leaf_type: str


class Sites:
    """Where a tree may stand: not on a road, in a building, in water or on paving, and not in a wall."""

    def __init__(
        self, roads: Iterable[Road], buildings: Iterable[Building], areas: Iterable[Area], barriers: Iterable[Barrier]
    ) -> None:
        taken: list[BaseGeometry] = [road.line.buffer(road.width_m / 2 + _FROM_ROAD_M) for road in roads]
        taken += [building.footprint.buffer(_FROM_WALL_M) for building in buildings]
        taken += [area.footprint for area in areas if area.kind != "grass"]
        taken += [barrier.line.buffer(_FROM_ROAD_M) for barrier in barriers]
        self._taken = STRtree(taken)

    def free(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of the points (n, 2) are free, as (n,)."""
        free = np.ones(len(points), dtype=np.bool_)
        free[self._taken.query(shapely.points(points), "intersects")[0]] = False
        return free


def scattered(woods: Sequence[Wood], sites: Sites) -> list[Tree]:
    """Return trees about 7.5 m apart in all woods, at most 800 in all; the same woods give the same trees."""
    total_m2 = sum(wood.polygon.area for wood in woods)
    boxes_m2 = sum(wood.polygon.envelope.area for wood in woods)
    spacing_m = max(_SPACING_M, math.sqrt(total_m2 / _MOST_SCATTERED), math.sqrt(boxes_m2 / _MOST_TRIED))
    trees: list[Tree] = []
    for wood in woods:
        rng = np.random.default_rng(zlib.crc32(f"wood {wood.number}".encode()))
        points = _jittered_grid(wood.polygon, spacing_m, rng)
        points = points[sites.free(points)]
        trees += _trees(points, wood.leaf_type, wood.height_m, rng)
    return trees[:_MOST_SCATTERED]


def in_rows(rows: Sequence[Row], sites: Sites) -> list[Tree]:
    """Return trees every 8 m along all rows."""
    trees: list[Tree] = []
    for row in rows:
        rng = np.random.default_rng(zlib.crc32(f"row {row.number}".encode()))
        places = np.arange(0.0, row.line.length + 1e-6, _ROW_M)
        points = shapely.get_coordinates(shapely.line_interpolate_point(row.line, places))
        trees += _trees(points[sites.free(points)], row.leaf_type, None, rng)
    return trees[:_MOST_IN_ROWS]


def _jittered_grid(polygon: Polygon, spacing_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    x_min, y_min, x_max, y_max = polygon.bounds
    across, up = np.arange(x_min, x_max, spacing_m), np.arange(y_min, y_max, spacing_m)
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    points = grid + rng.uniform(0.1, 0.9, grid.shape) * spacing_m
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, points[:, 0], points[:, 1])
    return np.asarray(points[inside], dtype=np.float64)


def _trees(points: NDArray[np.float64], leaf_type: str, height_m: float | None, rng: np.random.Generator) -> list[Tree]:
    needles = {"needleleaved": 1.0, "broadleaved": 0.0}.get(leaf_type, 0.25)
    draws = rng.uniform(size=(len(points), 3)).tolist()
    trees = []
    for (x, y), (leaf, shape, size) in zip(points.tolist(), draws, strict=True):
        kind: TreeKind = "conifer" if leaf < needles else BROAD[int(shape < 0.5)]
        trees.append(Tree(x, y, (height_m or USUAL_HEIGHT_M[kind]) * (0.8 + 0.4 * size), kind))
    return trees
