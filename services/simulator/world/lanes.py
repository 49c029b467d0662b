"""Lanes on a free floor: a visibility graph (Lozano-Perez and Wesley 1979) without long lanes."""

from collections.abc import Callable
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import LineString
from shapely.geometry.base import BaseGeometry

from services.simulator.world.place import Bounds, Scale

# Margin of lanes above the required clearance, for rounding to centimetres.
_MARGIN_M: Final = 0.02
# Maximum length of a lane, in distances of lane ends.
LONGEST: Final = 3.0


def floor_lanes(
    floor_off: Callable[[float], BaseGeometry], bounds: Bounds, scale: Scale, rough_m: float = 0.0
) -> tuple[LineString, ...]:
    """Return the lanes of a floor.

    Nodes are corners of the floor at `Scale.clearance_m` and at `Scale.room_m` from all obstacles,
    points along the edges, and a coarse grid on open floor.

    Parameters
    ----------
    floor_off : callable
        Returns the floor at least a distance (metres) from all obstacles.
    bounds : Bounds
        Bounds of the floor.
    scale : Scale
        Typical distances of the place.
    rough_m : float
        Roughness of the outlines. Smaller corners give no nodes, and nodes keep this distance more.
    """
    nodes = _nodes(floor_off, bounds, scale, rough_m)
    pairs = cKDTree(nodes).query_pairs(LONGEST * scale.lane_end_m, output_type="ndarray")
    lines = np.asarray(shapely.linestrings(nodes[pairs]))
    allowed = floor_off(scale.clearance_m)
    shapely.prepare(allowed)
    return tuple(lines[shapely.contains_properly(allowed, lines)])


def _nodes(
    floor_off: Callable[[float], BaseGeometry], bounds: Bounds, scale: Scale, rough_m: float
) -> NDArray[np.float64]:
    """Return the lane ends (n, 2), metres, rounded to centimetres."""
    free, roomy = (
        floor_off(distance_m + _MARGIN_M + rough_m).simplify(rough_m)
        for distance_m in (scale.clearance_m, scale.room_m)
    )
    edges = shapely.get_coordinates(shapely.segmentize(free, scale.lane_end_m))
    x_min, y_min, x_max, y_max = bounds
    grid = np.meshgrid(
        np.arange(x_min, x_max, scale.lane_end_m), np.arange(y_min, y_max, scale.lane_end_m)
    )
    open_floor = np.stack(grid, axis=-1).reshape(-1, 2)
    open_floor = open_floor[shapely.intersects_xy(roomy, open_floor)]
    return np.unique(
        np.round(np.concatenate([edges, shapely.get_coordinates(roomy), open_floor]), 2), axis=0
    )
