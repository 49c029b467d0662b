"""What stands in the robot's way, and the robot's hull, as plain geometry for a physics engine; knows no engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from services.simulator.scene.shapes import outline, sides

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray
    from shapely.geometry.base import BaseGeometry

    from services.simulator.world.place import Solid

# A line stands for something thin: a fence, a hedge, the edge of the world.
_HALF_THICKNESS_M: Final = 0.01
# Walls end so far above a robot's top, where it never meets their upper edge.
_ABOVE_M: Final = 1.0
# PhysX warns of triangles that are much larger than what touches them.
_LONGEST_WALL_M: Final = 20.0
_HULL_SIDES: Final = 32


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles that face the side from which their corners run anticlockwise.

    Attributes
    ----------
    vertices
        (n, 3) float32, metres, z up.
    triangles
        (m, 3) uint32, rows of `vertices`.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def upright_sides(solids: Iterable[Solid], under_m: float) -> TriangleMesh:
    """Return the outer and courtyard walls of solids, up to a metre above the robot; nothing flies here.

    Parameters
    ----------
    solids
        What stands in the way; lines are given a thickness of 2 cm, centred on them.
    under_m
        The robot's height: solids that begin there or above are left out; they are driven under.

    Returns
    -------
    The sides, facing away from the solids; without any solid an empty mesh.
    """
    walls = [
        sides(ring, solid.low_m, min(solid.high_m, under_m + _ABOVE_M))
        for solid in solids
        if solid.low_m < under_m
        for ring in _rings(solid.shape)
    ]
    corners = np.concatenate([np.empty((0, 4, 3)), *walls])
    quads = np.arange(4 * len(corners)).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return TriangleMesh(corners.reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))


def hull(radius_m: float, low_m: float, high_m: float) -> NDArray[np.float32]:
    """Return the corners (n, 3) of an upright prism about the z axis that lies within a cylinder, 0.5 % smaller."""
    angles = np.arange(_HULL_SIDES) * math.tau / _HULL_SIDES
    ring = radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    ends = [np.column_stack([ring, np.full(_HULL_SIDES, height)]) for height in (low_m, high_m)]
    return np.concatenate(ends).astype(np.float32)


def _rings(shape: BaseGeometry) -> list[NDArray[np.float64]]:
    """Return the closed outlines (k, 2) of all that a shape covers, each with the solid on its left."""
    parts = [
        part if part.geom_type == "Polygon" else part.buffer(_HALF_THICKNESS_M, cap_style="square", join_style="mitre")
        for part in shapely.get_parts(shape)
    ]
    polygons = shapely.segmentize(shapely.get_parts(parts), _LONGEST_WALL_M)
    return [ring for polygon in polygons for ring in outline(polygon)]
