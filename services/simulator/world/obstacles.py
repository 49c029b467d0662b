"""Obstacles on and beside the route that were absent in teaching: boxes, barriers, cars, chairs."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import shapely
from shapely import LineString
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring

from services.simulator.world.furniture import Furniture, FurnitureKind
from services.simulator.world.place import Pose, Solid, World, WorldError
from services.simulator.world.route import beside, obstacles_of, plan_route


def _thing(kind: FurnitureKind, width_m: float, depth_m: float, height_m: float) -> Furniture:
    colour = (214, 120, 40) if kind == "partition" else None
    return Furniture(
        kind=kind,
        x_m=0.0,
        y_m=0.0,
        width_m=width_m,
        depth_m=depth_m,
        height_m=height_m,
        colour=colour,
    )


#: Obstacles for the rescue robot and for the TurtleBot; the first of each kind can close a route.
# By whether the robot is an indoor robot.
_THINGS: Final = {
    False: (
        _thing("partition", 1.6, 0.3, 1.0),
        _thing("crate", 0.8, 0.8, 0.9),
        _thing("car", 1.8, 4.2, 1.46),
    ),
    True: (
        _thing("partition", 0.7, 0.12, 0.6),
        _thing("crate", 0.35, 0.35, 0.45),
        _thing("chair", 0.45, 0.45, 0.85),
    ),
}
# Reach of a closing obstacle to either side, in robot radii, unless a wall is nearer.
_CLOSED: Final = 12.0
#: Maximum offset of the free passage from the route, in robot radii: the belief tracks it there.
_ASIDE: Final = 4.75
_TRIES: Final = 400


@dataclass(frozen=True)
class Obstacle:
    """An obstacle at a pose, its front towards the heading."""

    piece: Furniture
    pose: Pose

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Solid parts at the obstacle's pose."""
        return tuple(
            one._replace(shape=self.pose.place(one.shape), opaque=False)
            for one in self.piece.solids
        )

    @cached_property
    def footprint(self) -> BaseGeometry:
        """Top view of the obstacle."""
        return self.pose.place(self.piece.footprint)


def stand_in_the_way(
    world: World, start: Pose, rng: np.random.Generator, count: int, *, blocked: bool = False
) -> tuple[Obstacle, ...]:
    """Place obstacles on and beside the route from a start to the victim.

    The obstacles stand on separate stretches of the route, away from its ends. A robot on the route
    would touch or nearly touch each. A passage of twice the robot's width stays free near the
    route, except at the obstacle that closes the middle of a blocked route.

    Raises
    ------
    WorldError
        The route has too little room.
    """
    way = _Way(world, start)
    standing = [way.closed(rng)] if blocked else []
    for near, far in pairwise(np.linspace(*way.usable, count + 1).tolist()):
        standing += way.place_obstacle(near, far, standing, rng)
    if len(standing) < count + blocked:
        raise WorldError(
            f"{world.name}: the route has room for {len(standing) - blocked} of {count} obstacles"
        )
    return tuple(standing)


class _Way:
    """Route of an episode, with the solid things around it."""

    def __init__(self, world: World, start: Pose) -> None:
        self._radius_m = world.robot.radius_m
        scale = world.scale
        self._obstacles = obstacles_of(world.place)
        self._things = _THINGS[world.robot.indoor]
        self._line = LineString(plan_route(world, (start.x, start.y)))
        #: Excludes the area where episodes begin and where the goal counts as found.
        first_m = 3 * scale.aside_m
        last_m = self._line.length - scale.found_m - 2 * self._radius_m
        self.usable = (first_m, max(first_m, last_m))
        around = self._line.buffer(2 * _ASIDE * self._radius_m)
        solids = (one for one in world.place.solids if one.low_m < world.robot.top_m)
        self._solid = shapely.union_all(
            [one.shape for one in solids if one.shape.intersects(around)]
        )

    def place_obstacle(
        self, near_m: float, far_m: float, others: list[Obstacle], rng: np.random.Generator
    ) -> list[Obstacle]:
        """Place an obstacle on a stretch with a free passage; return an empty list without room."""
        for _ in range(_TRIES):
            piece = self._things[int(rng.integers(len(self._things)))]
            along_m = rng.uniform(near_m, far_m)
            aside = rng.uniform(-1.0, 1.0)
            turned = rng.uniform(-0.4, 0.4)
            # The obstacle's side is between contact with the robot and half its width further away.
            centre = beside(self._line, along_m, aside * (piece.width_m / 2 + 1.5 * self._radius_m))
            obstacle = Obstacle(piece, Pose(centre.x, centre.y, centre.heading + turned))
            off = self._solid.disjoint(obstacle.footprint)
            off &= all(
                obstacle.footprint.distance(other.footprint) > 8 * self._radius_m
                for other in others
            )
            if off and self._passes(along_m, obstacle):
                return [obstacle]
        return []

    def _passes(self, along_m: float, obstacle: Obstacle) -> bool:
        """Return whether a passage twice as wide as the robot leads around an obstacle."""
        length_m = obstacle.footprint.length / 2 + 4 * self._radius_m
        stretch = substring(
            self._line, max(0.0, along_m - length_m), min(self._line.length, along_m + length_m)
        )
        beside = stretch.buffer(_ASIDE * self._radius_m, cap_style="flat")
        free = beside.difference(
            shapely.union_all([obstacle.footprint, self._solid]).buffer(2 * self._radius_m)
        )
        ends = [shapely.Point(stretch.coords[k]) for k in (0, -1)]
        return any(
            all(part.distance(end) < 0.05 for end in ends) for part in shapely.get_parts(free)
        )

    def closed(self, rng: np.random.Generator) -> Obstacle:
        """Return the obstacle that closes the route near its middle."""
        along_m = float(np.interp(rng.uniform(0.4, 0.6), (0.0, 1.0), self.usable))
        ends_m = []
        for side in (1.0, -1.0):
            steps = np.arange(0.0, _CLOSED * self._radius_m, self._radius_m / 2).tolist()
            # The end stands in the wall, which leaves no gap.
            there = ((one, beside(self._line, along_m, side * one).at(0.0)) for one in steps)
            walls = (one for one, xy in there if not self._obstacles.is_free(*xy, 0.0))
            ends_m.append(side * next(walls, _CLOSED * self._radius_m))
        thing = self._things[0]
        wide = _thing("partition", ends_m[0] - ends_m[1], thing.depth_m, thing.height_m)
        return Obstacle(wide, beside(self._line, along_m, sum(ends_m) / 2))
