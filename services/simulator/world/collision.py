"""What stands in the way: distances to obstacles, and lines of sight past buildings."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Point, STRtree

from services.simulator.world.place import Place


class Obstacles:
    """Everything solid of a place, and its edge, seen from above."""

    def __init__(self, place: Place) -> None:
        # What hangs higher than the robot is tall, as a building over a passage does, is driven under.
        in_the_way = [solid for solid in place.solids if solid.low_m < place.robot.top_m]
        self._bounds = place.bounds
        self._radius_m = place.robot.radius_m
        self._solid = STRtree([solid.shape for solid in in_the_way])
        self._walls = STRtree([solid.shape for solid in in_the_way if solid.opaque])

    def clearance(self, x: float, y: float) -> float:
        """Return the distance in metres from a point to the nearest obstacle; 0 inside one or outside the world."""
        if not self._contains(x, y):
            return 0.0
        _, distance = self._solid.query_nearest(Point(x, y), return_distance=True, all_matches=False)
        return float(distance[0])

    def is_free(self, x: float, y: float, radius_m: float | None = None) -> bool:
        """Return whether a circle about a point, by default the robot's, touches nothing."""
        radius_m = self._radius_m if radius_m is None else radius_m
        return self._contains(x, y) and self._solid.query(Point(x, y), "dwithin", radius_m).size == 0

    def are_clear(self, segments: NDArray[np.float64], clearance_m: float) -> NDArray[np.bool_]:
        """Return which segments (n, 2, 2) keep more than `clearance_m` from every obstacle, as (n,)."""
        return ~self._hits(self._solid, segments, clearance_m)

    def in_sight(self, segments: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which segments (n, 2, 2) nothing opaque interrupts, as (n,); trees and hedges are not counted on."""
        return ~self._hits(self._walls, segments, 0.0)

    def _contains(self, x: float, y: float) -> bool:
        x_min, y_min, x_max, y_max = self._bounds
        return x_min < x < x_max and y_min < y < y_max

    @staticmethod
    def _hits(tree: STRtree, segments: NDArray[np.float64], distance_m: float) -> NDArray[np.bool_]:
        hit = np.zeros(len(segments), dtype=np.bool_)
        lines = np.asarray(shapely.linestrings(segments))
        # GEOS finds nothing near a line without length, so that one is asked about as the point that it is.
        still = (segments[:, 0] == segments[:, 1]).all(axis=1)
        lines[still] = shapely.points(segments[still, 0])
        hit[tree.query(lines, "dwithin", distance_m)[0]] = True
        return hit


@lru_cache(maxsize=8)
def obstacles_of(place: Place) -> Obstacles:
    """Return the obstacles of a place, indexed once and shared."""
    return Obstacles(place)
