"""Choose tasks: a hidden victim, a distant start, and the starts of episodes."""

import itertools
import math
from collections.abc import Iterator
from typing import Final, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from schemas.episode import Purpose
from services.simulator.world.place import Place, Pose, Scale, World, WorldError
from services.simulator.world.route import (
    RoutesTo,
    beside,
    first_pose,
    lane_graph,
    obstacles_of,
    plan_route,
)

#: Distances by rule outdoors; they shrink with the clearance of the place.
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
# The victim must stay hidden from all starts, which scatter by `Scale.start_m`.
_JITTER: Final = 1.1
_MOST_CANDIDATES: Final = 400
_MOST_STARTS_TRIED: Final = 400
_JITTER_RAD: Final = math.radians(15)
_ASIDE_RAD: Final = math.radians(40)
_TRIES: Final = 1000


class RulePlace(Place, Protocol):
    """A place in which the rule can choose a task."""

    def walls_from(self, middle: shapely.Point) -> Iterator[NDArray[np.float64]]:
        """Yield lines (n, 2) along walls, with the solid on their left, nearest first."""


def choose_roles(
    place: RulePlace,
    start: Pose | None,
    victim: Pose | None,
    seed: int = 0,
    *,
    hidden: bool = True,
) -> tuple[Pose, Pose]:
    """Choose a start and a victim, keeping the given poses.

    The victim stands beside a wall: candidates begin at the wall nearest to the middle of the map
    (or to a seeded point). The victim must be reachable and hidden from a start 60 to 150 m away
    (less indoors); otherwise shorter and longer routes are tried. Without `hidden` the start can
    have a view of the victim.

    Raises
    ------
    WorldError
        No pair of poses fits.
    """
    if start is not None and victim is not None:
        return start, victim
    rule = _Rule(place, start, hidden=hidden)
    low, high = np.reshape(place.bounds, (2, 2))
    middle = shapely.Point(
        low
        + (high - low) * (0.5 if seed == 0 else np.random.default_rng(seed).uniform(0.1, 0.9, 2))
    )
    candidates = [victim] if victim is not None else rule.beside_walls(middle)
    second_best: dict[int, tuple[Pose, Pose]] = {}
    for spot in itertools.islice(candidates, _MOST_CANDIDATES):
        rank, found = rule.start_for(spot, min(second_best, default=len(_ROUTES_M)))
        if found is not None:
            second_best[rank] = found, spot
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


class _Rule:
    """Chooses starts for victims in a place."""

    def __init__(self, place: RulePlace, start: Pose | None, *, hidden: bool) -> None:
        self._place = place
        self._start = start
        self._hidden = hidden
        self._graph = lane_graph(place)
        self._obstacles = obstacles_of(place)
        # Distances in this place, relative to outdoors.
        self._size = place.scale.clearance_m / Scale.clearance_m

    def beside_walls(self, middle: shapely.Point) -> Iterator[Pose]:
        """Yield free poses beside walls, nearest to a point first."""
        for line in self._place.walls_from(middle):
            along = np.diff(line, axis=0)
            along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
            outwards = np.column_stack([along[:, 1], -along[:, 0]])
            places = (line[:-1] + line[1:]) / 2 + self._size * _FROM_WALL_M * outwards
            free = self._obstacles.are_free(places, self._size * _VICTIM_ROOM_M)
            for (x, y), (east, north) in zip(
                places[free].tolist(), along[free].tolist(), strict=True
            ):
                yield Pose(x, y, math.atan2(north, east))

    def start_for(self, victim: Pose, better_than: int) -> tuple[int, Pose | None]:
        """Return the rank of the best route length, and its start with a reachable victim."""
        goal = np.array([victim.x, victim.y])
        # Most places beside walls are unreachable by road; this quick check comes first.
        if len(self._graph.links(goal)[0]) == 0:
            return 0, None
        routes = RoutesTo(self._graph, goal)
        start = self._start
        if start is not None:
            here = np.array([[start.x, start.y]])
            fits = routes.path_from(here[0]) is not None and self._are_hidden(here, goal)[0]
            return 0, start if fits else None
        for rank, lengths_m in enumerate(_ROUTES_M[:better_than]):
            shortest, longest, preferred = (self._size * length_m for length_m in lengths_m)
            fitting = np.flatnonzero((routes.cost >= shortest) & (routes.cost <= longest))
            best_first = fitting[
                np.argsort(np.abs(routes.cost[fitting] - preferred), kind="stable")
            ]
            points = self._graph.points[best_first[:_MOST_STARTS_TRIED]]
            for here in points[self._are_hidden(points, goal)]:
                ahead = routes.path_from(here)
                if ahead is not None and self._obstacles.is_free(
                    float(here[0]), float(here[1]), self._size * _START_ROOM_M
                ):
                    return rank, first_pose(ahead)
        return 0, None

    def _are_hidden(
        self, starts: NDArray[np.float64], victim: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return from which starts (n, 2), and their surroundings, a victim is hidden, as (n,)."""
        if not self._hidden:
            return np.ones(len(starts), dtype=np.bool_)
        scatter_m = _JITTER * self._place.scale.start_m
        around = scatter_m * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
        corners = (starts[:, None] + around).reshape(-1, 2)
        sights = np.stack([corners, np.broadcast_to(victim, corners.shape)], axis=1)
        seen = self._obstacles.in_sight(sights).reshape(-1, len(around))
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
