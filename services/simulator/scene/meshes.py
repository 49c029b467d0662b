"""Triangle meshes with texture coordinates, in metres with z up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from services.simulator.world.place import Pose


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one texture.

    Attributes
    ----------
    vertices, normals
        (n, 3) float32.
    uvs
        (n, 2) float32; 1 is one repetition of the texture, v grows downwards in the picture.
    triangles
        (m, 3) uint32 rows of `vertices`, anticlockwise seen from outside.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    triangles: NDArray[np.uint32]

    def placed(self, pose: Pose, z: float = 0.0) -> Mesh:
        """Return the mesh turned about the vertical and moved."""
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return make(self.vertices @ turn + (pose.x, pose.y, z), self.normals @ turn, self.uvs, self.triangles)

    def flipped(self) -> Mesh:
        """Return the mesh with its inside out; the renderer draws outsides only."""
        return make(self.vertices, -self.normals, self.uvs, self.triangles[:, ::-1])


def make(vertices: ArrayLike, normals: ArrayLike, uvs: ArrayLike, triangles: ArrayLike) -> Mesh:
    """Return a mesh of the given arrays in the types that the renderer takes."""
    return Mesh(
        np.asarray(vertices, dtype=np.float32),
        np.asarray(normals, dtype=np.float32),
        np.asarray(uvs, dtype=np.float32),
        np.asarray(triangles, dtype=np.uint32),
    )


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh of all; at least one is needed. One big mesh draws much faster than many small ones."""
    parts = list(meshes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return make(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uvs for part in parts]),
        np.concatenate([part.triangles + offset for part, offset in zip(parts, offsets, strict=True)]),
    )


def quads(corners: ArrayLike, uvs: ArrayLike) -> Mesh:
    """Return flat quadrilaterals: corners (n, 4, 3) anticlockwise seen from outside, uvs (n, 4, 2)."""
    points = np.asarray(corners, dtype=np.float64)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 3] - points[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    first = 4 * np.arange(len(points))[:, None]
    triangles = np.concatenate([first + np.array(half) for half in ((0, 1, 2), (0, 2, 3))])
    return make(points.reshape(-1, 3), np.repeat(normal, 4, axis=0), np.reshape(uvs, (-1, 2)), triangles)


def grid(vertices: NDArray[np.float64], normals: NDArray[np.float64], uvs: NDArray[np.float64]) -> Mesh:
    """Return the surface over a grid of points, given as arrays (rows, columns, 3), the uvs (rows, columns, 2)."""
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    points = vertices.reshape(-1, 3)
    # At a pole, where all points of a row are one, half of the triangles have no area.
    a_b_c = points[triangles]
    solid = np.linalg.norm(np.cross(a_b_c[:, 1] - a_b_c[:, 0], a_b_c[:, 2] - a_b_c[:, 0]), axis=1) > 1e-12
    return make(points, normals.reshape(-1, 3), uvs.reshape(-1, 2), triangles[solid])
