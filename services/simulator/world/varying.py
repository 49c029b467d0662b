"""Variations of a world: other façades, and moved furniture and trees."""

import math
import zlib
from dataclasses import replace
from typing import Final

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from services.simulator.world.furniture import Furniture, FurnitureKind
from services.simulator.world.place import Place, World, WorldError
from services.simulator.world.room import Room
from services.simulator.world.route import plan_route
from services.simulator.world.scan import ScannedPlace
from services.simulator.world.terrain import Terrain, Tree

_TREE_MOVES_M: Final = 3.0
_FURNITURE_MOVES_M: Final = 0.3
_FURNITURE_TURNS_DEG: Final = 20.0
#: People move these kinds; cabinets and partitions stay.
_MOVABLE: Final[frozenset[FurnitureKind]] = frozenset({"crate", "plant", "table"})
_TRIES: Final = 20


def vary(world: World, *, facade_seed: int = 0, clutter_seed: int = 0) -> World:
    """Change the appearance or the movable objects of a world; start, victim and lanes stay.

    Parameters
    ----------
    world : World
        World to change.
    facade_seed : int
        Seed of façades and wall fittings; equal façades stay equal to each other. 0 keeps them.
    clutter_seed : int
        Seed of positions: trees move by up to 3 m, boxes, plants and tables by up to 0.3 m, at
        least `Scale.room_m` off the route. 0 keeps them.

    Raises
    ------
    WorldError
        The place is a scan, which has neither façades nor movable objects.
    """
    place = world.place
    if (facade_seed or clutter_seed) and isinstance(place, ScannedPlace):
        raise WorldError(
            f"{world.name}: a scan's surfaces and furniture cannot change; choose a --variation of "
            "light, haze or exposure"
        )
    if facade_seed:
        place = _repainted(place, facade_seed)
    if clutter_seed:
        kept_free = _kept_free(world)
        rng = np.random.default_rng(clutter_seed)
        if isinstance(place, Terrain):
            place = replace(place, trees=_replanted(place, kept_free, rng))
        elif isinstance(place, Room):
            place = replace(place, furniture=_pushed_about(place, kept_free, rng))
    return replace(world, place=place)


def _repainted(place: Place, seed: int) -> Place:
    if isinstance(place, Terrain):
        facades = {
            one: replace(one, colour=None, variant=_mixed(one, seed))
            for one in {building.facade for building in place.buildings}
        }
        buildings = (replace(one, facade=facades[one.facade]) for one in place.buildings)
        return replace(place, buildings=tuple(buildings))
    if isinstance(place, Room):
        fittings = (
            replace(one, colour=None, variant=_mixed((one.kind, one.variant), seed))
            for one in place.fittings
        )
        return replace(place, fittings=tuple(fittings))
    return place


def _mixed(facade: object, seed: int) -> int:
    return zlib.crc32(f"{facade!r} {seed}".encode())


def _kept_free(world: World) -> BaseGeometry:
    """Return the area to keep free: the route with its clearance, and the starts of episodes."""
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    scale = world.scale
    start = shapely.Point(world.start.x, world.start.y).buffer(
        2 * scale.start_m + scale.start_room_m
    )
    return shapely.union_all([route.buffer(scale.room_m), start])


def _replanted(
    terrain: Terrain, kept_free: BaseGeometry, rng: np.random.Generator
) -> tuple[Tree, ...]:
    frame = shapely.box(*terrain.bounds)
    solid = shapely.union_all(
        [building.footprint for building in terrain.buildings]
        + [road.line.buffer(road.width_m / 2) for road in terrain.roads]
        + [area.footprint for area in terrain.areas if area.kind == "water"]
    )
    shapely.prepare(solid)
    shapely.prepare(kept_free)
    found = []
    for tree in terrain.trees:
        choices = np.array([tree.x, tree.y]) + rng.uniform(
            -_TREE_MOVES_M, _TREE_MOVES_M, (_TRIES, 2)
        )
        trunks = shapely.buffer(shapely.points(choices), tree.trunk_radius_m)
        free = ~(shapely.intersects(trunks, solid) | shapely.intersects(trunks, kept_free))
        free &= shapely.within(trunks, frame)
        x, y = choices[free.argmax()].tolist() if free.any() else (tree.x, tree.y)
        found.append(replace(tree, x=x, y=y))
    return tuple(found)


def _pushed_about(
    room: Room, kept_free: BaseGeometry, rng: np.random.Generator
) -> tuple[Furniture, ...]:
    floor = shapely.box(*room.bounds)
    found = list(room.furniture)
    for number, piece in enumerate(found):
        # Drawn for every piece, so that pieces do not depend on each other.
        shifts = rng.uniform(-1.0, 1.0, (_TRIES, 3)) * (
            _FURNITURE_MOVES_M,
            _FURNITURE_MOVES_M,
            _FURNITURE_TURNS_DEG,
        )
        if piece.kind not in _MOVABLE:
            continue
        others = shapely.union_all(
            [other.footprint for other in found if other is not piece] + [kept_free]
        )
        for x, y, turn in shifts.tolist():
            x_m = piece.x_m + x
            y_m = piece.y_m + y
            facing_deg = math.remainder(piece.facing_deg + turn, 360.0)
            if not floor.contains(shapely.Point(x_m, y_m)):
                continue
            moved = replace(piece, x_m=x_m, y_m=y_m, facing_deg=facing_deg)
            if floor.covers(moved.footprint) and not moved.footprint.intersects(others):
                found[number] = moved
                break
    return tuple(found)
