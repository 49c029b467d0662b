"""Triangle meshes with texture coordinates (metres, z up), and the basic shapes of a world."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from services.simulator.world.furniture import Box
from services.simulator.world.place import Pose

UP: Final = np.array([0.0, 0.0, 1.0])
#: Texture coordinates of an upright rectangle, from its lower left corner.
UPRIGHT: Final = [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
# Slightly inset, since filtering wraps around at the edges.
_WHOLE: Final = [(0.003, 0.997), (0.997, 0.997), (0.997, 0.003), (0.003, 0.003)]
TEXTURE_M: Final = 0.6  # Texture period on furniture.


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one texture.

    Attributes
    ----------
    vertices, normals : array of shape (n, 3)
        Positions in metres, and unit normals.
    uvs : array of shape (n, 2)
        Texture coordinates; 1 is one repetition, v grows downwards.
    triangles : array of shape (m, 3)
        Indices of vertices, anticlockwise seen from outside.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    triangles: NDArray[np.uint32]

    def placed(self, pose: Pose) -> "Mesh":
        """Return the mesh rotated about the vertical axis and moved to a pose."""
        cos = math.cos(pose.heading)
        sin = math.sin(pose.heading)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return make(
            self.vertices @ turn + (pose.x, pose.y, 0.0),
            self.normals @ turn,
            self.uvs,
            self.triangles,
        )

    def flipped(self) -> "Mesh":
        """Return the mesh inside out; the renderer culls back faces."""
        return make(self.vertices, -self.normals, self.uvs, self.triangles[:, ::-1])


def make(vertices: ArrayLike, normals: ArrayLike, uvs: ArrayLike, triangles: ArrayLike) -> Mesh:
    """Build a mesh with the array types that the renderer takes."""
    return Mesh(
        np.asarray(vertices, dtype=np.float32),
        np.asarray(normals, dtype=np.float32),
        np.asarray(uvs, dtype=np.float32),
        np.asarray(triangles, dtype=np.uint32),
    )


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Merge at least one mesh into one; a large mesh draws faster than many small ones."""
    parts = list(meshes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return make(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uvs for part in parts]),
        np.concatenate(
            [part.triangles + offset for part, offset in zip(parts, offsets, strict=True)]
        ),
    )


def quads(corners: ArrayLike, uvs: ArrayLike) -> Mesh:
    """Build quadrilaterals: corners (n, 4, 3) anticlockwise from outside, uvs (n, 4, 2)."""
    points = np.asarray(corners, dtype=np.float64)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 3] - points[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    first = 4 * np.arange(len(points))[:, None]
    triangles = np.concatenate([first + np.array(half) for half in ((0, 1, 2), (0, 2, 3))])
    return make(
        points.reshape(-1, 3), np.repeat(normal, 4, axis=0), np.reshape(uvs, (-1, 2)), triangles
    )


def grid(
    vertices: NDArray[np.float64], normals: NDArray[np.float64], uvs: NDArray[np.float64]
) -> Mesh:
    """Build the surface over a grid of points (rows, columns, 3) with uvs (rows, columns, 2)."""
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a = index[:-1, :-1]
    b = index[1:, :-1]
    c = index[1:, 1:]
    d = index[:-1, 1:]
    triangles = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    return make(vertices.reshape(-1, 3), normals.reshape(-1, 3), uvs.reshape(-1, 2), triangles)


def outline(polygon: shapely.Polygon) -> list[NDArray[np.float64]]:
    """Return the closed rings (k, 2), with the solid on their left."""
    turned = shapely.orient_polygons(polygon)
    return [shapely.get_coordinates(ring) for ring in (turned.exterior, *turned.interiors)]


def sides(ring: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return upright rectangles (k - 1, 4, 3) along a ring (k, 2), lower right corner first."""
    begin = ring[:-1]
    end = ring[1:]
    foot = np.full((len(begin), 1), low)
    top = np.full((len(begin), 1), high)
    return np.stack(
        [
            np.hstack([begin, foot]),
            np.hstack([end, foot]),
            np.hstack([end, top]),
            np.hstack([begin, top]),
        ],
        axis=1,
    )


def walls(
    ring: NDArray[np.float64],
    low: float,
    high: float,
    u: NDArray[np.float64],
    v: tuple[float, float],
    which: NDArray[np.bool_] | None = None,
) -> Mesh:
    """Build upright walls between two heights along a closed ring (k, 2), the solid on its left.

    `u` (k - 1, 2) is the texture coordinate at both ends of each wall, `v` at foot and top. `which`
    (k - 1,) selects walls.
    """
    chosen = np.ones(len(u), dtype=bool) if which is None else which
    corners = sides(ring, low, high)[chosen]
    u = u[chosen]
    low_v, high_v = (np.full(len(corners), value) for value in v)
    coordinates = [(u[:, 0], low_v), (u[:, 1], low_v), (u[:, 1], high_v), (u[:, 0], high_v)]
    return quads(corners, np.stack([np.stack(pair, axis=1) for pair in coordinates], axis=1))


def band(polygon: shapely.Polygon, low: float, high: float, metres: float) -> Mesh:
    """Build plain walls around a polygon; the texture repeats every `metres`."""
    return merge(
        walls(ring, low, high, running(ring) / metres, (high / metres, low / metres))
        for ring in outline(polygon)
    )


def triangles(polygon: BaseGeometry) -> NDArray[np.float64]:
    """Triangulate an area: (n, 3, 2), anticlockwise."""
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    return shapely.get_coordinates(shapely.orient_polygons(parts)).reshape(-1, 4, 2)[:, :3]


def flat(
    polygon: shapely.Polygon, z: float, metres: float, normal: NDArray[np.float64] = UP
) -> Mesh:
    """Build a level area seen from above; the texture repeats every `metres`."""
    points = triangles(polygon).reshape(-1, 2)
    vertices = np.column_stack([points, np.full(len(points), z)])
    order = np.arange(len(points)).reshape(-1, 3)
    return make(vertices, np.broadcast_to(normal, vertices.shape), points / metres, order)


def faces(triangles: NDArray[np.float64], metres: tuple[float, float]) -> Mesh:
    """Build triangles (n, 3, 3), anticlockwise; the texture runs along the level and the slope."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice_area = np.linalg.norm(across, axis=1)
    solid = twice_area > 1e-9
    corners = triangles[solid]
    normal = across[solid] / twice_area[solid, None]
    level = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    tilt = np.linalg.norm(level, axis=1, keepdims=True)
    level = np.where(tilt > 1e-6, level / np.maximum(tilt, 1e-6), (1.0, 0.0, 0.0))
    up = np.cross(normal, level)
    uvs = np.stack(
        [np.einsum("nij,nj->ni", corners, level), -np.einsum("nij,nj->ni", corners, up)], axis=-1
    )
    order = np.arange(3 * len(corners)).reshape(-1, 3)
    return make(
        corners.reshape(-1, 3), np.repeat(normal, 3, axis=0), uvs.reshape(-1, 2) / metres, order
    )


def ball(centre: ArrayLike, radii: ArrayLike, detail: int) -> Mesh:
    """Build an ellipsoid of `detail` rings and twice as many sectors."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, detail + 1), np.linspace(0, 2 * np.pi, 2 * detail + 1), indexing="ij"
    )
    unit = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1
    )
    vertices = np.asarray(centre) + unit * np.asarray(radii)
    normals = unit / np.asarray(radii)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uvs = np.stack([around / np.pi, polar / np.pi], axis=-1)
    return grid(vertices, normals, uvs)


def tube(start: ArrayLike, end: ArrayLike, radii: tuple[float, float], sectors: int = 8) -> Mesh:
    """Build an open tube between two points (3,) with a radius at either end; radius 0 is a tip."""
    begin = np.asarray(start, dtype=np.float64)
    finish = np.asarray(end, dtype=np.float64)
    axis = finish - begin
    length = float(np.linalg.norm(axis))
    axis /= length
    side = np.cross(axis, UP if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    around = np.linspace(0, 2 * np.pi, sectors + 1)
    spokes = np.cos(around)[:, None] * side + np.sin(around)[:, None] * np.cross(axis, side)
    vertices = np.stack([finish + radii[1] * spokes, begin + radii[0] * spokes])
    slanted = spokes + axis * (radii[0] - radii[1]) / length
    normals = np.broadcast_to(
        slanted / np.linalg.norm(slanted, axis=1, keepdims=True), vertices.shape
    )
    u = around / np.pi
    uvs = np.stack(
        [np.column_stack([u, np.zeros_like(u)]), np.column_stack([u, np.full_like(u, length)])]
    )
    return grid(vertices, normals, uvs)


def drum(start: ArrayLike, end: ArrayLike, radius: float, sectors: int = 16) -> Mesh:
    """Build a tube with flat ends."""
    begin = np.asarray(start, dtype=np.float64)
    finish = np.asarray(end, dtype=np.float64)
    out = 1e-4 * (finish - begin) / np.linalg.norm(finish - begin)
    ends = [
        tube(begin, begin - out, (radius, 0.0), sectors),
        tube(finish, finish + out, (radius, 0.0), sectors),
    ]
    return merge([tube(begin, finish, (radius, radius), sectors), *ends])


def running(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (k - 1, 2) along the ring at the ends of each wall."""
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    ends = np.cumsum(lengths)
    return np.stack([ends - lengths, ends], axis=1)


def block(box: Box, low: float, high: float) -> Mesh:
    """Build a box with a repeating texture, and with an underside if it is off the floor."""
    outline = shapely.box(*box)
    sides = [band(outline, low, high, TEXTURE_M), flat(outline, high, TEXTURE_M)]
    return merge(sides if low <= 0.0 else [*sides, flat(outline, low, TEXTURE_M).flipped()])


def cased(box: Box, low: float, high: float) -> Mesh:
    """Build the four sides of a box, each with the whole picture."""
    return quads(sides(outline(shapely.box(*box))[0], low, high), [_WHOLE] * 4)


def front(box: Box, low: float, high: float) -> Mesh:
    """Build the front of a box with the whole picture."""
    _, left, x, right = box
    return quads([[(x, left, low), (x, right, low), (x, right, high), (x, left, high)]], [_WHOLE])
