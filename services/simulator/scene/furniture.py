"""Meshes of furniture with finishes; each piece fills its stated footprint and height."""

import zlib
from collections.abc import Iterator
from itertools import pairwise, product
from typing import Final

import numpy as np
import shapely

from services.simulator.scene.faces import FACES
from services.simulator.scene.meshes import ball, block, cased, drum, flat, front, tube
from services.simulator.scene.surfaces import Finish, Piece
from services.simulator.world.furniture import PARTS, Furniture

_BAY_M: Final = 1.0
_COMPARTMENT_M: Final = 0.36
_BOARD_M: Final = 0.022
_VARIANTS: Final = 4


def furnish(piece: Furniture) -> list[Piece]:
    """Return the pieces of furniture at its pose."""
    parts = {"plant": _plant, "shelf": _shelf}.get(piece.kind, _boxes)(piece)
    return [(finish, mesh.placed(piece.pose)) for finish, mesh in parts]


def _variant(piece: Furniture) -> int:
    """Return the look of a piece; equal size and colour give equal looks."""
    size = (piece.kind, piece.width_m, piece.depth_m, piece.height_m, piece.colour)
    return zlib.crc32(repr(size).encode()) % _VARIANTS


def _boxes(piece: Furniture) -> Iterator[Piece]:
    """Yield the drawn parts: cartons have a picture on each side, other pieces in front."""
    for part in PARTS[piece.kind]:
        colour = piece.colour or part.colour if part.own else part.colour
        box, low, high = piece.box(part)
        if part.wears in FACES:
            mesh = cased(box, low, high) if part.wears == "carton" else front(box, low, high)
            yield Finish(part.wears, colour, _variant(piece)), mesh
        elif part.wears == "tyre":
            x_min, right, x_max, left = box
            middle = (x_min + x_max) / 2
            radius = (high - low) / 2
            yield Finish(part.wears), drum((middle, right, radius), (middle, left, radius), radius)
        elif part.wears:
            yield Finish(part.wears, colour), block(box, low, high)


def _shelf(piece: Furniture) -> Iterator[Piece]:
    x = piece.depth_m / 2
    y = piece.width_m / 2
    bays = np.linspace(-y, y - _BOARD_M, max(1, round(piece.width_m / _BAY_M)) + 1).tolist()
    rows = np.linspace(
        0.04, piece.height_m - _BOARD_M, max(1, round(piece.height_m / _COMPARTMENT_M)) + 1
    ).tolist()
    wood = Finish("wood", piece.colour)
    yield wood, block((-x, -y, 0.012 - x, y), 0.0, piece.height_m)
    yield from ((wood, block((-x, left, x, left + _BOARD_M), 0.0, piece.height_m)) for left in bays)
    yield from ((wood, block((-x, -y, x, y), low, low + _BOARD_M)) for low in rows)
    for number, ((low, high), (left, right)) in enumerate(product(pairwise(rows), pairwise(bays))):
        books = front((-x, left + _BOARD_M, x - 0.05, right), low + _BOARD_M, high)
        yield Finish("books", None, (_variant(piece) + 3 * number) % 7), books


def _plant(piece: Furniture) -> Iterator[Piece]:
    radius = piece.width_m / 2
    height = piece.height_m
    pot = 0.3 * height
    yield (
        Finish("pot", piece.colour),
        tube((0, 0, 0), (0, 0, pot), (0.45 * radius, 0.62 * radius), 20),
    )
    yield Finish("soil"), flat(shapely.Point(0, 0).buffer(0.6 * radius), 0.92 * pot, 0.3)
    for up, out, size in ((0.38, 0.4, 0.45), (0.6, 0.45, 0.5), (0.8, 0.2, 0.4)):
        for turn in 2.1 * np.arange(3) + 9 * up:
            centre = out * radius * np.cos(turn), out * radius * np.sin(turn), up * height
            yield Finish("foliage"), ball(centre, (size * radius, size * radius, 0.18 * height), 8)
