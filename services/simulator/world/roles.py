"""Where the task of a terrain without one is: a hidden place for the victim and a start far from it."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import Pose, WorldError
from services.simulator.world.route import RoutesTo, lane_graph
from services.simulator.world.terrain import Terrain

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_FROM_WALL_M: Final = 1.2
_VICTIM_ROOM_M: Final = 0.9
_START_ROOM_M: Final = 1.8
_ROUTE_M: Final = (60.0, 150.0)
_PREFERRED_ROUTE_M: Final = 100.0
# A start is jittered by a metre, and the victim has to stay hidden all the same.
_JITTER_M: Final = 1.1
_MOST_CANDIDATES: Final = 400


def choose_roles(terrain: Terrain, start: Pose | None, victim: Pose | None) -> tuple[Pose, Pose]:
    """Return a start and a victim, keeping those that are given.

    The rule is deterministic: the first place beside a wall, counted from the building nearest to the middle, that
    a road point reaches and that some road point 60 to 150 m of way off does not see.

    Raises
    ------
    WorldError
        No pair of places fits.
    """
    if start is not None and victim is not None:
        return start, victim
    candidates = [victim] if victim is not None else _places_beside_walls(terrain)
    for count, place in enumerate(candidates):
        found = _start_for(terrain, place, start)
        if found is not None:
            return found, place
        if count >= _MOST_CANDIDATES:
            break
    raise WorldError(
        f"{terrain.name}: found no hidden place for the victim with a start 60 to 150 m of road away; "
        "tag two nodes smal:role=start (with direction=*) and smal:role=victim"
    )


def _places_beside_walls(terrain: Terrain) -> Iterator[Pose]:
    """Yield free places just outside the middle of walls, lying along the wall, from the terrain's middle outwards."""
    obstacles = obstacles_of(terrain)
    middle = shapely.box(*terrain.bounds).centroid
    for building in sorted(terrain.buildings, key=lambda building: building.footprint.distance(middle)):
        ring = shapely.get_coordinates(shapely.orient_polygons(building.footprint).exterior)
        for first, second in itertools.pairwise(ring):
            along = (second - first) / max(float(np.linalg.norm(second - first)), 1e-9)
            x, y = (first + second) / 2 + _FROM_WALL_M * np.array([along[1], -along[0]])
            if obstacles.is_free(x, y, _VICTIM_ROOM_M):
                yield Pose(float(x), float(y), math.atan2(along[1], along[0]))


def _start_for(terrain: Terrain, victim: Pose, start: Pose | None) -> Pose | None:
    """Return a start from which this victim is hidden and reachable, or None."""
    graph = lane_graph(terrain)
    goal = np.array([victim.x, victim.y])
    routes = RoutesTo(graph, goal)
    if start is not None:
        here = np.array([start.x, start.y])
        return start if routes.path_from(here) is not None and _is_hidden(terrain, here, goal) else None
    fitting = np.flatnonzero((routes.cost >= _ROUTE_M[0]) & (routes.cost <= _ROUTE_M[1]))
    nearest_first = fitting[np.argsort(np.abs(routes.cost[fitting] - _PREFERRED_ROUTE_M), kind="stable")]
    for node in nearest_first:
        here = graph.points[node]
        if obstacles_of(terrain).is_free(float(here[0]), float(here[1]), _START_ROOM_M) and _is_hidden(
            terrain, here, goal
        ):
            ahead = routes.path_from(here)
            if ahead is not None:
                east, north = ahead[1] - ahead[0]
                return Pose(float(here[0]), float(here[1]), math.atan2(north, east))
    return None


def _is_hidden(terrain: Terrain, start: NDArray[np.float64], victim: NDArray[np.float64]) -> bool:
    corners = start + _JITTER_M * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    sights = np.stack([corners, np.broadcast_to(victim, corners.shape)], axis=1)
    return not obstacles_of(terrain).in_sight(sights).any()
