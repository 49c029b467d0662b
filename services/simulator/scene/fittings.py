"""What hangs on a room's walls, and the walls themselves, as surfaces seen from inside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from services.simulator.scene.boxes import panel
from services.simulator.scene.finishes import Finish, Piece
from services.simulator.scene.interiors import paint_wall
from services.simulator.scene.meshes import Mesh, quads
from services.simulator.scene.surfaces import Surface
from services.simulator.world.room import FittingKind, Wall

if TYPE_CHECKING:
    from services.simulator.world.room import Fitting, Room, WallFrame

#: How far each kind stands off the wall.
_THICK_M: Final[dict[FittingKind, float]] = {"door": 0.03, "poster": 0.004, "whiteboard": 0.025, "window": 0.02}
_SKIRTING_M: Final = (0.08, 0.014)
_RIM: Final[dict[FittingKind, Finish]] = {
    "door": Finish("lacquer", (206, 206, 200)), "poster": Finish("white_plastic"),
    "whiteboard": Finish("aluminium"), "window": Finish("white_plastic"),
}  # fmt: skip


def walls(room: Room) -> list[Surface]:
    """Return the four painted walls."""
    made = []
    for number, wall in enumerate(get_args(Wall)):
        frame = room.wall_frame(wall)
        picture = paint_wall(room.look.walls, frame.length_m, room.wall_height_m, number)
        made.append(Surface(panel(frame.at(0.0), frame.at(frame.length_m), 0.0, room.wall_height_m), picture))
    return made


def skirting(room: Room) -> list[Piece]:
    """Return the skirting boards, with a gap where a door reaches the floor."""
    high, thick = _SKIRTING_M
    made: list[Piece] = []
    for wall in get_args(Wall):
        frame = room.wall_frame(wall)
        doors = sorted(
            (fitting.along_m - fitting.width_m / 2, fitting.along_m + fitting.width_m / 2)
            for fitting in room.fittings
            if fitting.wall == wall and fitting.foot_m < high
        )
        ends = np.array([0.0, *(end for door in doors for end in door), frame.length_m]).reshape(-1, 2)
        made += [
            (Finish("lacquer", (226, 223, 214)), _slab(frame, left, right, 0.0, high, thick))
            for left, right in ends.tolist()
            if right > left
        ]
    return made


def hang(fitting: Fitting, room: Room) -> tuple[Piece, Piece]:
    """Return a fitting's face and the rim about it."""
    frame = room.wall_frame(fitting.wall)
    left, right = fitting.along_m - fitting.width_m / 2, fitting.along_m + fitting.width_m / 2
    low, high, thick = fitting.foot_m, fitting.foot_m + fitting.height_m, _THICK_M[fitting.kind]
    face = panel(_off(frame, left, thick), _off(frame, right, thick), low, high)
    rim = _slab(frame, left, right, low, high, thick - 0.001)
    return (Finish(fitting.kind, fitting.colour, fitting.variant), face), (_RIM[fitting.kind], rim)


def _off(frame: WallFrame, along_m: float, off_m: float) -> tuple[float, float]:
    """Return a point in front of a wall, (x, y); to the left of its direction is outside."""
    x, y = frame.at(along_m)
    return x + off_m * frame.right[1], y - off_m * frame.right[0]


def _slab(frame: WallFrame, left: float, right: float, low: float, high: float, thick: float) -> Mesh:
    """Return a board on a wall: front, top, underside and ends."""
    back_left, back_right = frame.at(left), frame.at(right)
    front_left, front_right = _off(frame, left, thick), _off(frame, right, thick)
    upright = [(front_left, front_right), (back_left, front_left), (front_right, back_right)]
    faces = [[(*a, low), (*b, low), (*b, high), (*a, high)] for a, b in upright]
    faces.append([(*front_left, high), (*front_right, high), (*back_right, high), (*back_left, high)])
    faces.append([(*back_left, low), (*back_right, low), (*front_right, low), (*front_left, low)])
    uvs = np.broadcast_to([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)], (len(faces), 4, 2))
    return quads(faces, uvs)
