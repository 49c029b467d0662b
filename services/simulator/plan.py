"""Ground plan of a world for maps: what the robot stands on, and what stands in its way."""

from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from schemas.rpc import MOST_POINTS, MOST_SHAPES, PlanKind, PlanReply, PlanShape
from services.simulator.world.place import World, WorldError
from services.simulator.world.route import plan_route
from services.simulator.world.terrain import Terrain

_COARSE_M: Final = 0.1  # Details below it are invisible on a map.


def plan_of(world: World) -> PlanReply:
    """Return the shapes of a world; of a large one those nearest to its task."""
    start = (world.start.x, world.start.y)
    victim = (world.victim.x, world.victim.y)
    task = shapely.LineString([start, victim])
    kinds, whole = zip(*_drawn(world), strict=True)
    parts, of = shapely.get_parts(np.array(whole), return_index=True)
    # Stable: the ground stays below the things on it.
    near = np.sort(np.argsort(shapely.distance(task, parts), kind="stable")[:MOST_SHAPES])
    outer = shapely.get_exterior_ring(parts[near])
    filled = ~shapely.is_missing(outer)
    lines = shapely.simplify(np.where(filled, outer, parts[near]), _COARSE_M)
    shapes = tuple(
        PlanShape(kind=kinds[k], points=_points(line), filled=bool(fill))
        for k, line, fill in zip(of[near], lines, filled, strict=True)
    )
    return PlanReply(
        world=world.name, start=start, victim=victim, shapes=shapes, route=_route(world)
    )


def _route(world: World) -> tuple[tuple[float, float], ...]:
    try:
        return _points(shapely.LineString(plan_route(world, (world.start.x, world.start.y))))
    except WorldError:
        return ()  # The map shows the world all the same.


def _drawn(world: World) -> Iterator[tuple[PlanKind, BaseGeometry]]:
    if isinstance(world.place, Terrain):
        for area in world.place.areas:
            yield "water" if area.kind == "water" else "ground", area.footprint
        for road in world.place.roads:
            yield "street", road.line.buffer(road.width_m / 2)
    for solid in world.place.solids:
        yield "solid", solid.shape


def _points(line: BaseGeometry) -> tuple[tuple[float, float], ...]:
    return tuple((round(x, 1), round(y, 1)) for x, y in shapely.get_coordinates(line)[:MOST_POINTS])
