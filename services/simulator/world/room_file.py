"""Read a room with a task from a file of the format "smal.room/1", and refuse one that nobody could use."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from pydantic import ValidationError

from schemas.codec import describe
from services.simulator.world.collision import obstacles_of
from services.simulator.world.furniture import HIDING_M, ROUND, Furniture, FurnitureKind
from services.simulator.world.place import OverheadMount, Pose, Rgb, World, WorldError
from services.simulator.world.room import Fitting, Look, Room
from services.simulator.world.room_format import FittingEntry, FurnitureEntry, OverheadEntry, PlaceEntry, RoomEntry
from services.simulator.world.route import plan_route

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

#: Room that a standing victim takes, from its middle.
VICTIM_RADIUS_M: Final = 0.16
#: Smallest width and depth of kinds that consist of parts.
_SMALLEST_M: Final[dict[FurnitureKind, tuple[float, float]]] = {
    "desk": (0.8, 0.4), "shelf": (0.3, 0.15), "sofa": (0.8, 0.5), "table": (0.3, 0.3)
}  # fmt: skip
_TOLERANCE_M: Final = 1e-6


def read_room(content: dict[str, object], path: Path) -> World:
    """Return the world that a file describes.

    Parameters
    ----------
    content
        The file's JSON object, see `room_format.RoomEntry`.
    path
        The file, for messages and for the world's name.

    Raises
    ------
    WorldError
        The content is not of the format, something is outside the room or in the way, the victim cannot be reached,
        or it can be seen from a start although the file does not say "hidden": false.
    """
    try:
        entry = RoomEntry.model_validate(content)
        room = Room(
            name=path.stem,
            bounds=(0.0, 0.0, entry.east_west_m, entry.north_south_m),
            furniture=tuple(_furniture(entry, number) for number in range(len(entry.furniture))),
            fittings=tuple(_fitting(entry, number) for number in range(len(entry.fittings))),
            look=Look(entry.floor, _rgb(entry.wall_colour)),
            wall_height_m=entry.walls_m,
            mount=None if entry.overhead is None else _mount(entry.overhead, entry),
        )
        world = World(room, _pose(entry.start), _pose(entry.victim))
        _check_task(world, room)
        if entry.hidden:
            _check_hidden(world)
    except ValidationError as error:
        raise WorldError(f"{path}: {describe(error)}") from None
    except WorldError as error:
        raise WorldError(f"{path}: {error}") from None
    return world


def _furniture(entry: RoomEntry, number: int) -> Furniture:
    piece = entry.furniture[number]
    field = f"furniture.{number}"
    name = f"{field} ({piece.kind})"
    if (piece.depth_m is None) != (piece.kind in ROUND):
        raise WorldError(f"{field}.depth_m: a {piece.kind} {_depth_rule(piece)}")
    depth_m = piece.width_m if piece.depth_m is None else piece.depth_m
    width_least_m, depth_least_m = _SMALLEST_M.get(piece.kind, (0.0, 0.0))
    if piece.width_m < width_least_m or depth_m < depth_least_m:
        raise WorldError(f"{name}: is at least {width_least_m:g} m wide and {depth_least_m:g} m deep")
    if piece.height_m > entry.walls_m:
        raise WorldError(f"{field}.height_m: {piece.height_m:g} m does not fit under a ceiling at {entry.walls_m:g} m")
    made = Furniture(
        piece.kind, piece.x_m, piece.y_m, math.radians(piece.facing_deg), piece.width_m, depth_m, piece.height_m,
        None if piece.colour is None else _rgb(piece.colour),
    )  # fmt: skip
    floor = shapely.box(0.0, 0.0, entry.east_west_m, entry.north_south_m)
    if not floor.buffer(_TOLERANCE_M).covers(made.footprint):
        raise WorldError(f"{name}: at ({piece.x_m:g}, {piece.y_m:g}) m it reaches out of the room")
    return made


def _depth_rule(piece: FurnitureEntry) -> str:
    return "is round and has a width_m only" if piece.kind in ROUND else "needs one"


def _fitting(entry: RoomEntry, number: int) -> Fitting:
    fitting: FittingEntry = entry.fittings[number]
    length_m = entry.east_west_m if fitting.wall in {"south", "north"} else entry.north_south_m
    half_m = fitting.width_m / 2
    if not half_m - _TOLERANCE_M <= fitting.along_m <= length_m - half_m + _TOLERANCE_M:
        raise WorldError(
            f"fittings.{number}.along_m: the {fitting.kind} reaches past an end of the {fitting.wall} wall"
        )
    if fitting.foot_m + fitting.height_m > entry.walls_m + _TOLERANCE_M:
        raise WorldError(f"fittings.{number}.foot_m: the {fitting.kind} reaches above the wall")
    return Fitting(
        fitting.kind, fitting.wall, fitting.along_m, fitting.foot_m, fitting.width_m, fitting.height_m,
        fitting.variant, None if fitting.colour is None else _rgb(fitting.colour),
    )  # fmt: skip


def _mount(camera: OverheadEntry, entry: RoomEntry) -> OverheadMount:
    if not (camera.x_m <= entry.east_west_m and camera.y_m <= entry.north_south_m):
        raise WorldError(f"overhead: at ({camera.x_m:g}, {camera.y_m:g}) m it hangs outside the room")
    return OverheadMount(
        camera.x_m, camera.y_m, camera.height_m, math.radians(camera.up_deg),
        camera.width_px, camera.height_px, camera.focal_px,
    )  # fmt: skip


def _pose(place: PlaceEntry) -> Pose:
    return Pose(place.x_m, place.y_m, math.remainder(math.radians(place.facing_deg), math.tau))


def _check_task(world: World, room: Room) -> None:
    """Refuse a start or a victim without room, and a victim without a way."""
    for role, pose, least_m in (
        ("start", world.start, world.scale.start_room_m), ("victim", world.victim, VICTIM_RADIUS_M)
    ):  # fmt: skip
        here = shapely.Point(pose.x, pose.y)
        if not shapely.box(*room.bounds).buffer(-least_m).covers(here):
            raise WorldError(f"{role}: ({pose.x:g}, {pose.y:g}) m is not inside the room, {least_m:g} m from its walls")
        for number, piece in enumerate(room.furniture):
            if piece.footprint.distance(here) < least_m:
                name = f"furniture.{number} ({piece.kind})"
                raise WorldError(f"{role}: ({pose.x:g}, {pose.y:g}) m is less than {least_m:g} m from {name}")
    try:
        plan_route(world, (world.start.x, world.start.y))
    except WorldError:
        raise WorldError(
            f"victim: no way leads there from the start that keeps {world.scale.clearance_m:g} m from everything"
        ) from None


def _check_hidden(world: World) -> None:
    seen = sights(world)[obstacles_of(world.place).in_sight(sights(world))]
    if len(seen):
        x, y = seen[0, 0]
        raise WorldError(
            f"victim: can be seen from a start, ({x:.2f}, {y:.2f}) m; put something of {HIDING_M:g} m between, "
            'or say "hidden": false'
        )


def sights(world: World) -> NDArray[np.float64]:
    """Return lines of sight (n, 2, 2) from starts, on a grid of 3 by 3, to the victim's middle and its sides."""
    offsets = (-world.scale.start_m, 0.0, world.scale.start_m)
    starts = np.array([(world.start.x + x, world.start.y + y) for x, y in itertools.product(offsets, repeat=2)])
    victim = np.array([world.victim.x, world.victim.y])
    across = np.stack([victim[1] - starts[:, 1], starts[:, 0] - victim[0]], axis=1)
    across *= VICTIM_RADIUS_M / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), _TOLERANCE_M)
    return np.concatenate([np.stack([starts, victim + side * across], axis=1) for side in (-1.0, 0.0, 1.0)])


def _rgb(colour: str) -> Rgb:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
