"""Boxes and upright rectangles, which most furniture is made of; x towards the front."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import shapely

from services.simulator.scene.meshes import Mesh, merge, quads
from services.simulator.scene.shapes import band, flat

if TYPE_CHECKING:
    from services.simulator.world.furniture import Box, Furniture

#: A material's picture repeats after so much of furniture.
TEXTURE_M: Final = 0.6


def block(box: Box, low: float, high: float) -> Mesh:
    """Return a box with a repeating texture: sides, top, and an underside if it is off the floor."""
    outline = shapely.box(*box)
    sides = [band(outline, low, high, TEXTURE_M), flat(outline, high, TEXTURE_M)]
    return merge(sides if low <= 0.0 else [*sides, flat(outline, low, TEXTURE_M).flipped()])


def panel(left: tuple[float, float], right: tuple[float, float], low: float, high: float) -> Mesh:
    """Return an upright rectangle that wears a whole picture, given its ends (x, y) seen from outside."""
    corners = [(*left, low), (*right, low), (*right, high), (*left, high)]
    edge = 0.003
    return quads([corners], [[(edge, 1 - edge), (1 - edge, 1 - edge), (1 - edge, edge), (edge, edge)]])


def cased(box: Box, low: float, high: float) -> Mesh:
    """Return the four sides of a box, each with the whole picture."""
    x_min, y_min, x_max, y_max = box
    corners = [(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)]
    return merge(panel(corners[side], corners[(side + 1) % 4], low, high) for side in range(4))


def box_of(piece: Furniture) -> Box:
    """Return what a piece of furniture covers, in its own frame."""
    return -piece.depth_m / 2, -piece.width_m / 2, piece.depth_m / 2, piece.width_m / 2


def front(box: Box, low: float, high: float, ahead_m: float = 0.0) -> Mesh:
    """Return the front of a box with the whole picture, perhaps a little before it."""
    _, y_min, x_max, y_max = box
    return panel((x_max + ahead_m, y_min), (x_max + ahead_m, y_max), low, high)
