"""Trees of woods, orchards and rows, which maps do not contain individually."""

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
# Trees cost rendering time; larger woods are thinned.
_MOST_SCATTERED: Final = 800
_MOST_IN_ROWS: Final = 2_000
_MOST_TRIED: Final = 500_000
# Clearance of trunks from roads, so that lanes stay free, and of crowns from walls.
_FROM_ROAD_M: Final = 1.6
_FROM_WALL_M: Final = 1.8
#: Broad-leaved kinds, and default heights of trees.
BROAD: Final[tuple[TreeKind, TreeKind]] = ("round", "tall")
USUAL_HEIGHT_M: Final[dict[TreeKind, float]] = {"round": 7.0, "tall": 11.0, "conifer": 10.0}


class Planting(NamedTuple):
    """An area or line with trees; the element's id seeds their positions."""

    number: int
    shape: Polygon | LineString
    leaf_type: str  # OpenStreetMap value: "broadleaved", "needleleaved", else mixed.
    height_m: float | None = None  # Height of a tree; None for the kind's default.


def planted(
    plantings: Sequence[Planting],
    roads: Iterable[Road],
    buildings: Iterable[Building],
    areas: Iterable[Area],
    barriers: Iterable[Barrier],
) -> list[Tree]:
    """Plant trees along rows and in woods, off roads, buildings, water and walls; deterministic."""
    if not plantings:
        return []
    taken: list[BaseGeometry] = [
        road.line.buffer(road.width_m / 2 + _FROM_ROAD_M) for road in roads
    ]
    taken += [building.footprint.buffer(_FROM_WALL_M) for building in buildings]
    taken += [area.footprint for area in areas if area.kind != "grass"]
    taken += [barrier.line.buffer(_FROM_ROAD_M) for barrier in barriers]
    tree = STRtree(taken)
    woods = [one.shape for one in plantings if isinstance(one.shape, Polygon)]
    total_m2 = sum(wood.area for wood in woods)
    boxes_m2 = sum(wood.envelope.area for wood in woods)
    spacing_m = max(
        _SPACING_M, math.sqrt(total_m2 / _MOST_SCATTERED), math.sqrt(boxes_m2 / _MOST_TRIED)
    )
    in_rows: list[Tree] = []
    scattered: list[Tree] = []
    for number, shape, leaf_type, height_m in plantings:
        wood = isinstance(shape, Polygon)
        rng = np.random.default_rng(zlib.crc32(f"{'wood' if wood else 'row'} {number}".encode()))
        if isinstance(shape, Polygon):
            points = _jittered_grid(shape, spacing_m, rng)
        else:
            places = np.arange(0.0, shape.length + 1e-6, _ROW_M)
            points = shapely.get_coordinates(shapely.line_interpolate_point(shape, places))
        free = np.ones(len(points), dtype=np.bool_)
        free[tree.query(shapely.points(points), "intersects")[0]] = False
        (scattered if wood else in_rows).extend(_trees(points[free], leaf_type, height_m, rng))
    return [*in_rows[:_MOST_IN_ROWS], *scattered[:_MOST_SCATTERED]]


def _jittered_grid(
    polygon: Polygon, spacing_m: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    x_min, y_min, x_max, y_max = polygon.bounds
    across = np.arange(x_min, x_max, spacing_m)
    up = np.arange(y_min, y_max, spacing_m)
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    points = grid + rng.uniform(0.1, 0.9, grid.shape) * spacing_m
    shapely.prepare(polygon)
    return np.asarray(
        points[shapely.contains_xy(polygon, points[:, 0], points[:, 1])], dtype=np.float64
    )


def _trees(
    points: NDArray[np.float64], leaf_type: str, height_m: float | None, rng: np.random.Generator
) -> list[Tree]:
    needles = {"needleleaved": 1.0, "broadleaved": 0.0}.get(leaf_type, 0.25)
    draws = rng.uniform(size=(len(points), 3)).tolist()
    trees = []
    for (x, y), (leaf, shape, size) in zip(points.tolist(), draws, strict=True):
        kind: TreeKind = "conifer" if leaf < needles else BROAD[int(shape < 0.5)]
        trees.append(Tree(x, y, (height_m or USUAL_HEIGHT_M[kind]) * (0.8 + 0.4 * size), kind))
    return trees
