"""Choose tasks: a hidden victim, a distant start, and the starts of episodes."""

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
#: Ranges of route length, in order of preference, and the preferred length; small maps have no long
#: routes.
_ROUTES_M: Final = (
    (60.0, 150.0, 100.0),
    (35.0, 250.0, 60.0),
    (20.0, 400.0, 35.0),
    (10.0, 1000.0, 20.0),
)
# The victim must stay hidden from all starts, which scatter by a metre.
_JITTER_M: Final = 1.1
_MOST_CANDIDATES: Final = 400
_MOST_STARTS_TRIED: Final = 400
_JITTER_RAD: Final = math.radians(15)
_ASIDE_RAD: Final = math.radians(40)
_TRIES: Final = 1000


def choose_roles(
    terrain: Terrain, start: Pose | None, victim: Pose | None, seed: int = 0
) -> tuple[Pose, Pose]:
    """Choose a start and a victim, keeping the given poses.

    The victim stands beside a wall: candidates begin at the building nearest to the middle of the
    map (or to a seeded point). The victim must be reachable by road and hidden from a start 60 to
    150 m away along roads; otherwise shorter and longer routes are tried.

    Raises
    ------
    WorldError
        No pair of poses fits.
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
        given = "" if start is victim is None else " with the given pose"
        raise WorldError(
            f"start and victim not found{given}: the victim must be hidden from the start, "
            f"reachable by road and at least {_ROUTES_M[-1][0]:.0f} m away; give both, or tag two nodes "
            "smal:role=start (with direction=*) and smal:role=victim"
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
    """Return the rank of the best route length, and its start with a hidden, reachable victim."""
    goal = np.array([victim.x, victim.y])
    # Most places beside walls are unreachable by road; this quick check comes first.
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
    """Return from which starts (n, 2), and their surroundings, a victim is hidden, as (n,)."""
    around = _JITTER_M * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
    corners = (starts[:, None] + around).reshape(-1, 2)
    sights = np.stack([corners, np.broadcast_to(victim, corners.shape)], axis=1)
    seen = obstacles_of(terrain).in_sight(sights).reshape(-1, len(around))
    return np.asarray(~seen.any(axis=1))


def moved_victim(world: World, rng: np.random.Generator) -> Pose:
    """Draw the pose of a moved victim: free, in sight of its place, within `Scale.moved_m`."""
    victim = world.victim
    obstacles = obstacles_of(world.place)
    scale = world.scale
    for _ in range(_TRIES):
        away_m = scale.moved_m * math.sqrt(rng.uniform())
        towards = rng.uniform(0.0, math.tau)
        x = victim.x + away_m * math.cos(towards)
        y = victim.y + away_m * math.sin(towards)
        sight = np.array([[(victim.x, victim.y), (x, y)]])
        if obstacles.is_free(x, y, scale.clearance_m) and obstacles.in_sight(sight)[0]:
            return Pose(x, y, victim.heading)
    raise WorldError(f"{world.name}: no free place within {scale.moved_m:g} m of the victim")


def sample_start(world: World, rng: np.random.Generator, purpose: Purpose) -> Pose:
    """Draw a free start pose.

    For `drive` and `run` the pose is within `Scale.start_m` and 15 degrees of the world's start.
    For `recovery` it is beside the route (without its last `Scale.last_m`), up to `Scale.aside_m`
    aside and 40 degrees off.

    Raises
    ------
    WorldError
        No free pose in 1000 draws.
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
    """Return whether the pose is free and unobstructed from its anchor."""
    leg = np.array([[(pose.x, pose.y), anchor]])
    # Room to turn, so that an episode does not begin with a collision.
    return bool(obstacles_of(world.place).are_clear(leg, world.scale.start_room_m)[0])
