"""Furniture as meshes, with what they wear; each piece fills the footprint and the height that it states."""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from services.simulator.scene.boxes import TEXTURE_M, block, box_of, cased, front
from services.simulator.scene.finishes import Finish, Piece
from services.simulator.scene.shapes import flat
from services.simulator.scene.soft_furniture import chair, plant, sofa
from services.simulator.world.furniture import BOARD_M, Furniture, FurnitureKind, legs_of, panels_of
from services.simulator.world.place import Pose

if TYPE_CHECKING:
    from collections.abc import Callable

_CRATE_M: Final = 0.36
_CRATE_TURN_RAD: Final = 0.09
_BAY_M: Final = 1.0
_COMPARTMENT_M: Final = 0.36
_SHELF_BOARD_M: Final = 0.022
_VARIANTS: Final = 4


def furnish(piece: Furniture) -> list[Piece]:
    """Return a piece of furniture where it stands."""
    pose = Pose(piece.x, piece.y, piece.heading)
    return [(finish, mesh.placed(pose)) for finish, mesh in _MAKERS[piece.kind](piece)]


def _variant(piece: Furniture) -> int:
    """Return which of a few looks a piece has, by its size and colour, so that equal pieces look the same."""
    size = (piece.kind, piece.width_m, piece.depth_m, piece.height_m, piece.colour)
    return zlib.crc32(repr(size).encode()) % _VARIANTS


def _crate(piece: Furniture) -> list[Piece]:
    """Return cardboard boxes on top of each other, every second one turned a little and smaller."""
    count = max(1, round(piece.height_m / _CRATE_M))
    side, top = Finish("carton", piece.colour, _variant(piece)), Finish("cardboard", piece.colour)
    step = piece.height_m / count
    made: list[Piece] = []
    for level in range(count):
        turn, shrink = (Pose(0.0, 0.0, 0.0), 1.0) if level % 2 == 0 else _turned_within(piece)
        x, y = shrink * piece.depth_m / 2, shrink * piece.width_m / 2
        box = (-x, -y, x, y)
        low, high = level * step, (level + 1) * step
        lid = flat(shapely.box(*box), high, TEXTURE_M)
        made += [(side, cased(box, low, high).placed(turn)), (top, lid.placed(turn))]
        tape = flat(shapely.box(-x, -0.05 * piece.width_m, x, 0.05 * piece.width_m), high + 0.001, 1.0)
        made.append((Finish("lacquer", (206, 178, 128)), tape.placed(turn)))
    return made


def _turned_within(piece: Furniture) -> tuple[Pose, float]:
    """Return how an upper box is turned, and how much smaller it is so that it stays within the footprint."""
    cos, sin = math.cos(_CRATE_TURN_RAD), math.sin(_CRATE_TURN_RAD)
    x, y = piece.depth_m, piece.width_m
    return Pose(0.0, 0.0, _CRATE_TURN_RAD), min(0.84, x / (x * cos + y * sin), y / (y * cos + x * sin))


def _cabinet(piece: Furniture) -> list[Piece]:
    """Return a steel cabinet with drawers in front, on a dark plinth."""
    box = box_of(piece)
    x_min, y_min, x_max, y_max = box
    steel = Finish("lacquer", piece.colour)
    body = (x_min, y_min, x_max - 0.01, y_max)
    return [
        (Finish("black_plastic"), block((x_min + 0.02, y_min + 0.02, x_max - 0.03, y_max - 0.02), 0.0, 0.05)),
        (steel, block(body, 0.05, piece.height_m)),
        (Finish("drawers", piece.colour, 0), front(body, 0.06, piece.height_m - 0.01, 0.01)),
    ]


def _shelf(piece: Furniture) -> list[Piece]:
    """Return an open shelf: carcass, boards, and a row of books on each."""
    x_min, y_min, x_max, y_max = box = box_of(piece)
    wood = Finish("wood", piece.colour)
    rows = max(1, round(piece.height_m / _COMPARTMENT_M))
    bays = max(1, round(piece.width_m / _BAY_M))
    made: list[Piece] = [(wood, block((x_min, y_min, x_min + 0.012, y_max), 0.0, piece.height_m))]
    uprights = np.linspace(y_min, y_max - _SHELF_BOARD_M, bays + 1)
    made += [(wood, block((x_min, y, x_max, y + _SHELF_BOARD_M), 0.0, piece.height_m)) for y in uprights]
    heights = np.linspace(0.04, piece.height_m - _SHELF_BOARD_M, rows + 1)
    made += [(wood, block(box, float(z), float(z) + _SHELF_BOARD_M)) for z in heights]
    for row in range(rows):
        low, high = float(heights[row]) + _SHELF_BOARD_M, float(heights[row + 1])
        for bay in range(bays):
            books = (x_min, float(uprights[bay]) + _SHELF_BOARD_M, x_max - 0.05, float(uprights[bay + 1]))
            made.append((Finish("books", None, (_variant(piece) + 3 * row + bay) % 7), front(books, low, high)))
    return made


def _partition(piece: Furniture) -> list[Piece]:
    """Return a screen of cloth panels in aluminium frames on flat rails."""
    x_min, y_min, x_max, y_max = box_of(piece)
    cloth, metal = Finish("fabric", piece.colour), Finish("aluminium")
    count = max(1, round(piece.width_m / _BAY_M))
    joints = np.linspace(y_min, y_max, count + 1)
    thin = 0.3 * piece.depth_m
    made: list[Piece] = []
    for left, right in zip(joints[:-1].tolist(), joints[1:].tolist(), strict=True):
        made.append((cloth, block((-thin, left + 0.025, thin, right - 0.025), 0.06, piece.height_m - 0.025)))
        made.append((metal, block((-thin - 0.004, left, thin + 0.004, right), piece.height_m - 0.025, piece.height_m)))
        made.append((metal, block((-thin - 0.004, left, thin + 0.004, right), 0.03, 0.06)))
        made += [
            (metal, block((-thin - 0.004, edge, thin + 0.004, edge + 0.025), 0.0, piece.height_m - 0.01))
            for edge in (left, right - 0.025)
        ]
        made.append((Finish("dark_plastic"), block((x_min, left + 0.1, x_max, right - 0.1), 0.0, 0.03)))
    return made


def _desk(piece: Furniture) -> list[Piece]:
    """Return a desk with drawers, a screen and a keyboard on it; what stands on top is above its height."""
    box = box_of(piece)
    x_min, _, _, y_max = box
    board, white = Finish("board", piece.colour), Finish("lacquer", (214, 214, 210))
    under = piece.height_m - BOARD_M
    drawers, side, back = panels_of(piece)
    made: list[Piece] = [(board, block(box, under, piece.height_m))]
    made += [(white, block(part, 0.0, under)) for part in (drawers, side, back)]
    made.append((Finish("drawers", (214, 214, 210), 1), front(drawers, 0.03, under - 0.02, 0.002)))
    black = Finish("black_plastic")
    top = piece.height_m
    screen = (x_min + 0.14, -0.28, x_min + 0.17, 0.28)
    made += [
        (black, block((x_min + 0.08, -0.12, x_min + 0.26, 0.12), top, top + 0.015)),
        (black, block((x_min + 0.13, -0.03, x_min + 0.15, 0.03), top, top + 0.14)),
        (black, block(screen, top + 0.12, top + 0.46)),
        (Finish("screen", None, 2), front(screen, top + 0.13, top + 0.45, 0.002)),
        (Finish("dark_plastic"), block((0.02, -0.22, 0.16, 0.22), top, top + 0.02)),
        (Finish("white_plastic"), block((x_min + 0.1, y_max - 0.36, x_min + 0.32, y_max - 0.2), top, top + 0.03)),
    ]
    return made


def _table(piece: Furniture) -> list[Piece]:
    """Return a table on four steel legs, with a rail under its board."""
    x_min, y_min, x_max, y_max = box = box_of(piece)
    under = piece.height_m - BOARD_M
    steel = Finish("dark_plastic")
    made: list[Piece] = [(Finish("board", piece.colour), block(box, under, piece.height_m))]
    made += [(steel, block(leg, 0.0, under)) for leg in legs_of(piece)]
    rail = 0.05
    made += [
        (steel, block((x_min + 0.02, y, x_max - 0.02, y + 0.025), under - rail, under))
        for y in (y_min + 0.02, y_max - 0.045)
    ]
    made += [
        (steel, block((x, y_min + 0.02, x + 0.025, y_max - 0.02), under - rail, under))
        for x in (x_min + 0.02, x_max - 0.045)
    ]
    return made


_MAKERS: Final[dict[FurnitureKind, Callable[[Furniture], list[Piece]]]] = {
    "cabinet": _cabinet, "chair": chair, "crate": _crate, "desk": _desk, "partition": _partition, "plant": plant,
    "shelf": _shelf, "sofa": sofa, "table": _table,
}  # fmt: skip
