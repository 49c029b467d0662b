"""What of a scene a camera can see: square cells of it, by a box around each; knows nothing of SAPIEN."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from services.kit.going_on import each
from services.simulator.scene.meshes import make

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from services.simulator.scene.surfaces import Surface

#: Side of a cell in metres. Larger ones hide less, smaller ones cost more calls of the driver.
CELL_M: Final = 80.0
# A scene no wider than this is drawn whole: hiding parts of it would cost more than it saves.
_WHOLE_M: Final = 120.0

Cell = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Cells:
    """A scene in pieces.

    Attributes
    ----------
    surfaces
        Of each of n cells what lies in it.
    boxes
        (n, 2, 3) lowest and highest corner of a box around each cell, metres.
    """

    surfaces: tuple[tuple[Surface, ...], ...]
    boxes: NDArray[np.float64]

    def seen(
        self, eye: NDArray[np.float64], axes: NDArray[np.float64], tangents: tuple[float, float], far_m: float
    ) -> list[int]:
        """Return the cells that a camera may see, the nearest first, so that what they hide is not painted.

        Parameters
        ----------
        eye
            (3,) position of the camera, metres.
        axes
            (3, 3) unit vectors ahead, to the left and up, in rows.
        tangents
            Of half the angle that the camera sees across, and upright.
        far_m
            How far it sees.
        """
        inside = np.ones(len(self.boxes), dtype=bool)
        for inward in _planes(axes, tangents):
            # The corner of a box that is furthest along the inward normal: if that is outside, all of the box is.
            furthest = np.where(inward > 0, self.boxes[:, 1], self.boxes[:, 0])
            inside &= (furthest - eye) @ inward >= 0
        away = np.maximum(0.0, np.maximum(self.boxes[:, 0] - eye, eye - self.boxes[:, 1]))
        away_m = np.linalg.norm(away, axis=1)
        inside &= away_m <= far_m
        return [int(number) for number in np.argsort(away_m, kind="stable") if inside[number]]


def in_cells(surfaces: Iterable[Surface]) -> Cells:
    """Cut surfaces into cells, each triangle to the cell in which its middle lies."""
    found: dict[Cell, list[Surface]] = defaultdict(list)
    every = list(surfaces)
    whole = _width(every) <= _WHOLE_M
    for surface in each(every):
        for cell, piece in [((0, 0), surface)] if whole else _pieces(surface):
            found[cell].append(piece)
    return Cells(tuple(map(tuple, found.values())), np.array([_box(pieces) for pieces in found.values()]))


def _pieces(surface: Surface) -> Iterator[tuple[Cell, Surface]]:
    mesh = surface.mesh
    middles = mesh.vertices[mesh.triangles].mean(axis=1)[:, :2]
    cells, owner = np.unique(np.floor(middles / CELL_M).astype(int), axis=0, return_inverse=True)
    for number, (column, row) in enumerate(cells):
        triangles = mesh.triangles[owner.ravel() == number]
        used, renumbered = np.unique(triangles, return_inverse=True)
        part = make(mesh.vertices[used], mesh.normals[used], mesh.uvs[used], renumbered.reshape(triangles.shape))
        yield (int(column), int(row)), replace(surface, mesh=part)


def _planes(axes: NDArray[np.float64], tangents: tuple[float, float]) -> Iterator[NDArray[np.float64]]:
    """Return vectors into what a camera sees, at right angles to the planes through its eye that enclose it."""
    ahead = axes[0]
    yield ahead
    for side, tangent in zip(axes[1:], tangents, strict=True):
        yield ahead * tangent + side
        yield ahead * tangent - side


def _box(surfaces: Iterable[Surface]) -> NDArray[np.float64]:
    vertices = np.concatenate([surface.mesh.vertices for surface in surfaces])
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)]).astype(np.float64)


def _width(surfaces: list[Surface]) -> float:
    return float(np.ptp(_box(surfaces), axis=0)[:2].max()) if surfaces else 0.0
