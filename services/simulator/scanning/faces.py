"""Geometry of a scan's triangles, computed once per import."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PartFaces:
    """Triangles of a part.

    Attributes
    ----------
    corners : array of shape (n, 3, 3)
        Corners, anticlockwise seen from outside.
    normals : array of shape (n, 3)
        Unit normals.
    areas : array of shape (n,)
    both : bool
        Whether the back faces are visible.
    """

    corners: NDArray[np.float64]
    normals: NDArray[np.float64]
    areas: NDArray[np.float64]
    both: bool

    @classmethod
    def of(cls, corners: NDArray[np.float64], *, both: bool) -> "PartFaces":
        """Return the geometry of triangles; the normal of an empty triangle is zero."""
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(cross, axis=1)
        normals = cross / np.where(double > 0, double, 1.0)[:, None]
        return cls(corners, normals, double / 2, both)

    def chosen(self, which: NDArray[np.bool_]) -> "PartFaces":
        """Return some of the triangles."""
        return PartFaces(self.corners[which], self.normals[which], self.areas[which], self.both)

    def turned(self, turn: NDArray[np.float64], scale: float) -> "PartFaces":
        """Return the triangles after a rotation (3, 3) and scaling."""
        return PartFaces(
            self.corners @ turn.T * scale, self.normals @ turn.T, self.areas * scale**2, self.both
        )
