"""Obstacles of a place, and shortest routes to the victim along lanes."""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from shapely import LineString, Point, STRtree
from shapely.geometry.base import BaseGeometry

from services.simulator.world.place import Place, Pose, Solid, World, WorldError

# Cost of a metre of tight lane, and of a metre off the lanes, in metres of lane.
_TIGHT_COST: Final = 3.0
_OFF_LANE_COST: Final = 1.5
_ROUND: Final = 16  # Growth of the rounds; 8 and 64 were not faster on usual maps.


class Obstacles:
    """Top view of a place's solid things, its edge, and additional solids."""

    def __init__(self, place: Place, more: Iterable[Solid] = ()) -> None:
        # The robot drives under solids above its height, such as a building over a passage.
        in_the_way = [solid for solid in (*place.solids, *more) if solid.low_m < place.robot.top_m]
        self._bounds = place.bounds
        self._radius_m = place.robot.radius_m
        self._solid = _Shapes([solid.shape for solid in in_the_way])
        self._walls = _Shapes([solid.shape for solid in in_the_way if solid.opaque])

    def clearance(self, x: float, y: float) -> float:
        """Return the distance to the nearest obstacle, metres; 0 inside or off the world."""
        if not self._contains(x, y):
            return 0.0
        return self._solid.distance(Point(x, y))

    def is_free(self, x: float, y: float, radius_m: float | None = None) -> bool:
        """Return whether a circle about a point, by default of the robot's radius, is free."""
        return bool(
            self.are_free(np.array([[x, y]]), self._radius_m if radius_m is None else radius_m)[0]
        )

    def are_free(self, places: NDArray[np.float64], radius_m: float) -> NDArray[np.bool_]:
        """Return whether a circle about each point (n, 2) is free, shape (n,)."""
        inside = np.array([self._contains(x, y) for x, y in places.tolist()], dtype=np.bool_)
        return inside & ~self._solid.near(np.asarray(shapely.points(places)), radius_m)

    def are_clear(self, segments: NDArray[np.float64], clearance_m: float) -> NDArray[np.bool_]:
        """Return which segments (n, 2, 2) keep more than `clearance_m` from obstacles."""
        return ~self._solid.near(_lines(segments), clearance_m)

    def in_sight(self, segments: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether segments (n, 2, 2) are unobstructed by opaque things, shape (n,)."""
        return ~self._walls.near(_lines(segments), 0.0)

    def _contains(self, x: float, y: float) -> bool:
        x_min, y_min, x_max, y_max = self._bounds
        return x_min < x < x_max and y_min < y < y_max


class _Shapes:
    """Index of shapes in rounds of growing size.

    The cost of a query grows with the number of overlapping shapes. Shapes of the first rounds
    already decide most positions, which later rounds skip.
    """

    def __init__(self, shapes: Sequence[BaseGeometry]) -> None:
        every = np.array(shapes, dtype=object)
        # Shuffled, since neighbours in a file are often neighbours on the map.
        mixed = np.random.default_rng(0).permutation(len(every))
        sizes = _ROUND ** np.arange(1, math.ceil(math.log(max(len(every), _ROUND), _ROUND)))
        self._rounds = [STRtree(every[some]) for some in np.split(mixed, sizes)]

    def near(self, places: NDArray[np.object_], distance_m: float) -> NDArray[np.bool_]:
        """Return whether each geometry (n,) is within a distance of a shape, shape (n,)."""
        near = np.zeros(len(places), dtype=np.bool_)
        for tree in self._rounds:
            left = np.flatnonzero(~near)
            near[left[tree.query(places[left], "dwithin", distance_m)[0]]] = True
        return near

    def distance(self, place: Point) -> float:
        """Return the distance to the nearest shape."""
        found = [
            tree.query_nearest(place, return_distance=True, all_matches=False)[1]
            for tree in self._rounds
        ]
        return float(np.concatenate(found).min())


def _lines(segments: NDArray[np.float64]) -> NDArray[np.object_]:
    """Convert segments (n, 2, 2) to geometries, (n,)."""
    lines = np.asarray(shapely.linestrings(segments))
    # GEOS ignores zero-length lines, so they become points.
    still = (segments[:, 0] == segments[:, 1]).all(axis=1)
    lines[still] = shapely.points(segments[still, 0])
    return lines


@lru_cache(maxsize=8)
def obstacles_of(place: Place) -> Obstacles:
    """Return the cached obstacles of a place."""
    return Obstacles(place)


class LaneGraph:
    """Points (n, 2) along a place's lanes, connected where the edge is free."""

    def __init__(self, place: Place) -> None:
        self._scale = place.scale
        self._radius_m = place.robot.radius_m
        self._obstacles = obstacles_of(place)
        lines = [shapely.segmentize(lane, self._scale.spacing_m) for lane in place.lanes]
        if not lines:
            raise WorldError(f"{place.name}: no drivable road")
        chains = [shapely.get_coordinates(line) for line in lines]
        # Lanes meet at shared points, compared in centimetres because of projection errors.
        keys = np.round(np.concatenate(chains), 2)
        points, index = np.unique(keys, axis=0, return_inverse=True)
        self.points = np.asarray(points, dtype=np.float64)
        #: Symmetric and sparse (n, n): cost of an edge in metres, higher where it is tight.
        self.costs = self._edges(_consecutive(chains, index.ravel()))

    def _edges(self, pairs: NDArray[np.int64]) -> csr_array:
        segments = self.points[pairs]
        clear = self._obstacles.are_clear(segments, self._scale.clearance_m)
        roomy = self._obstacles.are_clear(segments, self._scale.room_m)
        length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
        cost = np.where(roomy, length, length * _TIGHT_COST)[clear]
        # Sparse matrices add up duplicates; keep one of each pair.
        ends, once = np.unique(np.sort(pairs[clear], axis=1), axis=0, return_index=True)
        half = coo_array(
            (cost[once], tuple(ends.T)), shape=(len(self.points), len(self.points))
        ).tocsr()
        return csr_array(half + half.T)

    def links(self, xy: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the lane points within a straight free leg of `xy`, and the cost of each leg."""
        scale = self._scale
        here = np.asarray(xy, dtype=np.float64)
        distance = np.linalg.norm(self.points - here, axis=1)
        near = np.flatnonzero(distance <= scale.longest_leg_m)
        legs = np.stack([np.broadcast_to(here, (len(near), 2)), self.points[near]], axis=1)
        # From a tight position, such as a robot off its route, legs only need to avoid contact.
        tight = self._obstacles.clearance(float(here[0]), float(here[1])) <= scale.clearance_m
        clear = self._obstacles.are_clear(legs, self._radius_m if tight else scale.clearance_m)
        free = near[clear]
        legs = legs[clear]
        # The end can be a victim beside a wall, or a robot off its route.
        share = np.minimum(1.0, scale.leg_end_m / np.maximum(distance[free], scale.leg_end_m))[
            :, None
        ]
        legs[:, 0] += share * (legs[:, 1] - legs[:, 0])
        roomy = self._obstacles.are_clear(legs, scale.leg_room_m)
        return free, distance[free] * _OFF_LANE_COST * np.where(roomy, 1.0, _TIGHT_COST)


class RoutesTo:
    """Shortest routes from every lane point to a goal."""

    def __init__(self, graph: LaneGraph, goal: ArrayLike) -> None:
        self._graph = graph
        self._goal = np.asarray(goal, dtype=np.float64)
        size = len(graph.points)
        ends, leg_costs = graph.links(self._goal)
        # The goal is one more node, with a one-way edge to each lane point within reach.
        extended = graph.costs.tocoo()
        rows = np.concatenate([extended.row, np.full(len(ends), size)])
        columns = np.concatenate([extended.col, ends])
        costs = np.concatenate([extended.data, leg_costs])
        network = coo_array((costs, (rows, columns)), shape=(size + 1, size + 1)).tocsr()
        cost, before = dijkstra(network, indices=np.array(size), return_predecessors=True)
        self.cost = cost[:size]
        self._towards_goal = before[:size]

    def path_from(self, start: ArrayLike) -> NDArray[np.float64] | None:
        """Return the corners (k, 2) of the route from `start` to the goal, or None."""
        here = np.asarray(start, dtype=np.float64)
        entries, leg_costs = self._graph.links(here)
        total = leg_costs + self.cost[entries]
        if len(entries) == 0 or not np.isfinite(total.min()):
            return None
        node = int(entries[total.argmin()])
        corners = [here]
        while node != len(self._graph.points):
            corners.append(self._graph.points[node])
            node = int(self._towards_goal[node])
        # The topology-preserving simplifier hangs on some paths with nearly equal points.
        line = shapely.simplify(LineString([*corners, self._goal]), 0.02, preserve_topology=False)
        return np.asarray(shapely.get_coordinates(line), dtype=np.float64)


@lru_cache(maxsize=8)
def lane_graph(place: Place) -> LaneGraph:
    """Return the cached lane graph of a place."""
    return LaneGraph(place)


@lru_cache(maxsize=8)
def _routes_to_victim(world: World) -> RoutesTo:
    return RoutesTo(lane_graph(world.place), (world.victim.x, world.victim.y))


def plan_route(world: World, start_xy: ArrayLike) -> NDArray[np.float64]:
    """Plan a route from any position to the victim.

    The route leads to the lanes, along them, and from them to the victim. It keeps at least
    `Scale.clearance_m` from solid things; a tight first leg keeps the robot's radius.

    Returns
    -------
    array of shape (k, 2)
        Corners in metres, k at least 2.

    Raises
    ------
    WorldError
        No free route exists.
    """
    path = _routes_to_victim(world).path_from(start_xy)
    if path is None:
        x, y = np.asarray(start_xy, dtype=np.float64)
        name = f"{world.name}: " if world.name else ""
        victim = world.victim
        raise WorldError(
            f"{name}no route from ({x:.1f}, {y:.1f}) m to the victim at "
            f"({victim.x:.1f}, {victim.y:.1f}) m"
        )
    return path


def beside(way: LineString, along_m: float, aside_m: float = 0.0) -> Pose:
    """Return a pose beside a route, offset to the left, with the route's direction."""
    along_m = min(max(along_m, 0.0), way.length - 0.1)
    here = way.interpolate(along_m)
    there = way.interpolate(along_m + 0.1)
    along = Pose(here.x, here.y, math.atan2(there.y - here.y, there.x - here.x))
    return Pose(*along.at(0.0, aside_m), along.heading)


def first_pose(route: NDArray[np.float64]) -> Pose:
    """Return the pose at the start of a route (k, 2) that faces along its first leg."""
    x, y = route[0].tolist()
    east, north = (route[1] - route[0]).tolist()
    return Pose(x, y, math.atan2(north, east))


def route_length_m(route: NDArray[np.float64]) -> float:
    """Return the length of a route (k, 2), metres."""
    return float(shapely.LineString(route).length)


def _consecutive(chains: list[NDArray[np.float64]], index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return index pairs (m, 2) of consecutive points of the chains."""
    last = np.cumsum([len(chain) for chain in chains]) - 1
    first = np.setdiff1d(np.arange(len(index) - 1), last)
    pairs = np.stack([index[first], index[first + 1]], axis=1)
    return np.asarray(pairs[pairs[:, 0] != pairs[:, 1]], dtype=np.int64)
