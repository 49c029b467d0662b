"""Where the task is: a hidden place for the victim and a start far from it, and where episodes begin."""

import itertools
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from schemas.episode import Purpose
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.route import (
    LaneGraph,
    RoutesTo,
    beside,
    lane_graph,
    obstacles_of,
    plan_route,
)
from services.simulator.world.terrain import Terrain

_FROM_WALL_M: Final = 1.2
_VICTIM_ROOM_M: Final = 0.9
_START_ROOM_M: Final = 1.8
#: Lengths of way between start and victim, the best first, and which is preferred; a small map has no long ways.
_ROUTES_M: Final = (
    (60.0, 150.0, 100.0),
    (35.0, 250.0, 60.0),
    (20.0, 400.0, 35.0),
    (10.0, 1000.0, 20.0),
)
# A start is jittered by a metre, and the victim has to stay hidden all the same.
_JITTER_M: Final = 1.1
_MOST_CANDIDATES: Final = 400
_MOST_STARTS_TRIED: Final = 400
_JITTER_RAD: Final = math.radians(15)
_ASIDE_RAD: Final = math.radians(40)
_TRIES: Final = 1000


def choose_roles(
    terrain: Terrain, start: Pose | None, victim: Pose | None, seed: int = 0
) -> tuple[Pose, Pose]:
    """Return a start and a victim, keeping those that are given; a `WorldError` where no pair of places fits.

    The victim is at the first place beside a wall, from the building nearest to the middle (or to a point drawn with
    the seed), that a road reaches and that is not seen from some point 60 to 150 m of road off; else shorter and longer
    ways.
    """
    if start is not None and victim is not None:
        return start, victim
    graph = lane_graph(terrain)
    low, high = np.reshape(terrain.bounds, (2, 2))
    middle = shapely.Point(
        low
        + (high - low) * (0.5 if seed == 0 else np.random.default_rng(seed).uniform(0.1, 0.9, 2))
    )
    candidates = [victim] if victim is not None else _places_beside_walls(terrain, middle)
    second_best: dict[int, tuple[Pose, Pose]] = {}
    for place in itertools.islice(candidates, _MOST_CANDIDATES):
        rank, found = _start_for(
            terrain, graph, place, start, min(second_best, default=len(_ROUTES_M))
        )
        if found is not None:
            second_best[rank] = found, place
            if rank == 0:
                break
    if not second_best:
        given = "" if start is victim is None else " with the one that is given"
        raise WorldError(
            f"found no start and victim{given}: the start must see nothing of the victim, reach it by road and be at "
            f"least {_ROUTES_M[-1][0]:.0f} m away; give both, or tag two nodes smal:role=start (with direction=*) and "
            "smal:role=victim"
        )
    return second_best[min(second_best)]


def _places_beside_walls(terrain: Terrain, middle: shapely.Point) -> Iterator[Pose]:
    obstacles = obstacles_of(terrain)
    for building in sorted(
        terrain.buildings, key=lambda building: building.footprint.distance(middle)
    ):
        ring = shapely.get_coordinates(shapely.orient_polygons(building.footprint).exterior)
        along = np.diff(ring, axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        outwards = np.column_stack([along[:, 1], -along[:, 0]])
        places = (ring[:-1] + ring[1:]) / 2 + _FROM_WALL_M * outwards
        free = obstacles.are_free(places, _VICTIM_ROOM_M)
        for (x, y), (east, north) in zip(places[free].tolist(), along[free].tolist(), strict=True):
            yield Pose(x, y, math.atan2(north, east))


def _start_for(
    terrain: Terrain, graph: LaneGraph, victim: Pose, start: Pose | None, better_than: int
) -> tuple[int, Pose | None]:
    """Return a start from which this victim is hidden and reachable, or None, and how good its way's length is."""
    goal = np.array([victim.x, victim.y])
    # Most places beside walls are not reached from a road: asked first, since that is quick.
    if len(graph.links(goal)[0]) == 0:
        return 0, None
    routes = RoutesTo(graph, goal)
    if start is not None:
        here = np.array([[start.x, start.y]])
        fits = routes.path_from(here[0]) is not None and _are_hidden(terrain, here, goal)[0]
        return 0, start if fits else None
    for rank, (shortest, longest, preferred) in enumerate(_ROUTES_M[:better_than]):
        fitting = np.flatnonzero((routes.cost >= shortest) & (routes.cost <= longest))
        best_first = fitting[np.argsort(np.abs(routes.cost[fitting] - preferred), kind="stable")]
        points = graph.points[best_first[:_MOST_STARTS_TRIED]]
        for here in points[_are_hidden(terrain, points, goal)]:
            ahead = routes.path_from(here)
            if ahead is not None and obstacles_of(terrain).is_free(
                float(here[0]), float(here[1]), _START_ROOM_M
            ):
                east, north = ahead[1] - ahead[0]
                return rank, Pose(float(here[0]), float(here[1]), math.atan2(north, east))
    return 0, None


def _are_hidden(
    terrain: Terrain, starts: NDArray[np.float64], victim: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return from which starts (n, 2), and from beside which, nothing is seen of a victim, as (n,)."""
    around = _JITTER_M * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    corners = (starts[:, None] + around).reshape(-1, 2)
    sights = np.stack([corners, np.broadcast_to(victim, corners.shape)], axis=1)
    seen = obstacles_of(terrain).in_sight(sights).reshape(-1, len(around))
    return np.asarray(~seen.any(axis=1))


def moved_victim(world: World, rng: np.random.Generator) -> Pose:
    """Draw where a victim lies that has moved up to `Scale.moved_m`: free, in sight of its place; else a WorldError."""
    there = world.victim
    obstacles = obstacles_of(world.place)
    scale = world.scale
    for _ in range(_TRIES):
        away_m = scale.moved_m * math.sqrt(rng.uniform())
        towards = rng.uniform(0.0, math.tau)
        x = there.x + away_m * math.cos(towards)
        y = there.y + away_m * math.sin(towards)
        sight = np.array([[(there.x, there.y), (x, y)]])
        if obstacles.is_free(x, y, scale.clearance_m) and obstacles.in_sight(sight)[0]:
            return Pose(x, y, there.heading)
    raise WorldError(f"{world.name}: no free place within {scale.moved_m:g} m of the victim")


def sample_start(world: World, rng: np.random.Generator, purpose: Purpose) -> Pose:
    """Draw a free start pose; the same chance gives the same pose. WorldError where 1000 draws find none.

    Of `drive` and `run` it is within `Scale.start_m` and 15 degrees of the world's start; of `recovery` beside the
    route, but for its last `Scale.last_m`: up to `Scale.aside_m` aside and 40 degrees turned away.
    """
    draw = _beside_route if purpose == "recovery" else _about_start
    for _ in range(_TRIES):
        pose = draw(world, rng)
        if pose is not None:
            return pose
    raise WorldError(f"{world.name}: no free start pose for purpose '{purpose}' in {_TRIES} draws")


def _about_start(world: World, rng: np.random.Generator) -> Pose | None:
    x, y, heading = (
        rng.uniform(-1.0, 1.0, 3) * (world.scale.start_m, world.scale.start_m, _JITTER_RAD)
    ).tolist()
    start = world.start
    pose = Pose(start.x + x, start.y + y, math.remainder(start.heading + heading, math.tau))
    return pose if _reaches(world, pose, np.array([start.x, start.y])) else None


def _beside_route(world: World, rng: np.random.Generator) -> Pose | None:
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    along = rng.uniform(0.0, max(route.length - world.scale.last_m, 0.0))
    aside, turned = rng.uniform(-1.0, 1.0, 2) * (world.scale.aside_m, _ASIDE_RAD)
    here = beside(route, along)
    there = beside(route, along, aside)
    pose = Pose(there.x, there.y, math.remainder(there.heading + turned, math.tau))
    return pose if _reaches(world, pose, np.array([here.x, here.y])) else None


def _reaches(world: World, pose: Pose, anchor: NDArray[np.float64]) -> bool:
    """Return whether the pose is free and nothing stands between it and the place that it was drawn about."""
    leg = np.array([[(pose.x, pose.y), anchor]])
    # With room to turn, so that an episode does not begin with a collision.
    return bool(obstacles_of(world.place).are_clear(leg, world.scale.start_room_m)[0])
