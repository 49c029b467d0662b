"""Ground plan of a world for maps: what the robot stands on, and what stands in its way."""

from collections.abc import Iterator
from typing import Final

import shapely
from shapely.geometry.base import BaseGeometry

from schemas.rpc import MOST_SHAPES, PlanKind, PlanReply, PlanShape
from services.simulator.world.place import World
from services.simulator.world.terrain import Terrain

_COARSE_M: Final = 0.1  # Details below it are invisible on a map.


def plan_of(world: World) -> PlanReply:
    """Return the shapes of a world; of a large one those nearest to its task."""
    start = (world.start.x, world.start.y)
    victim = (world.victim.x, world.victim.y)
    task = shapely.LineString([start, victim])
    drawn = [(kind, part) for kind, shape in _drawn(world) for part in shapely.get_parts(shape)]
    # Stable: the ground stays below the things on it.
    near = sorted(range(len(drawn)), key=lambda k: task.distance(drawn[k][1]))[:MOST_SHAPES]
    shapes = tuple(_shape(*drawn[k]) for k in sorted(near))
    return PlanReply(world=world.name, start=start, victim=victim, shapes=shapes)


def _drawn(world: World) -> Iterator[tuple[PlanKind, BaseGeometry]]:
    if isinstance(world.place, Terrain):
        for area in world.place.areas:
            yield "water" if area.kind == "water" else "ground", area.footprint
        for road in world.place.roads:
            yield "street", road.line.buffer(road.width_m / 2)
    for solid in world.place.solids:
        yield "solid", solid.shape


def _shape(kind: PlanKind, geometry: BaseGeometry) -> PlanShape:
    outer = shapely.get_exterior_ring(geometry)
    line = shapely.simplify(geometry if outer is None else outer, _COARSE_M)
    points = tuple((round(x, 1), round(y, 1)) for x, y in shapely.get_coordinates(line)[:1000])
    return PlanShape(kind=kind, points=points, filled=outer is not None)
