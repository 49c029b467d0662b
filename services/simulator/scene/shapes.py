"""The few shapes that a world is made of, as meshes: walls, floors, roofs, balls and tubes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from services.simulator.scene.meshes import Mesh, grid, make, merge, quads

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

UP: Final = np.array([0.0, 0.0, 1.0])


def outline(polygon: shapely.Polygon) -> list[NDArray[np.float64]]:
    """Return the rings (k, 2), each closed, with the solid on their left: the outside of a wall is to the right."""
    turned = shapely.orient_polygons(polygon)
    return [shapely.get_coordinates(ring) for ring in (turned.exterior, *turned.interiors)]


def walls(ring: NDArray[np.float64], low: float, high: float, u: NDArray[np.float64], v: tuple[float, float]) -> Mesh:
    """Return upright walls along a closed ring (k, 2).

    Parameters
    ----------
    ring
        Corners with the solid on the left, the first one repeated at the end.
    low, high
        Height of the foot and of the top.
    u
        (k - 1, 2) texture coordinate at the beginning and end of each wall.
    v
        Texture coordinate at the foot and at the top.
    """
    begin, end = ring[:-1], ring[1:]
    foot, top = np.full((len(begin), 1), low), np.full((len(begin), 1), high)
    corners = np.stack(
        [np.hstack([begin, foot]), np.hstack([end, foot]), np.hstack([end, top]), np.hstack([begin, top])], axis=1
    )
    low_v, high_v = (np.full(len(begin), value) for value in v)
    coordinates = [(u[:, 0], low_v), (u[:, 1], low_v), (u[:, 1], high_v), (u[:, 0], high_v)]
    return quads(corners, np.stack([np.stack(pair, axis=1) for pair in coordinates], axis=1))


def band(polygon: shapely.Polygon, low: float, high: float, metres: float) -> Mesh:
    """Return plain walls around a polygon whose texture repeats every `metres`."""
    return merge(
        walls(ring, low, high, _running(ring) / metres, (high / metres, low / metres)) for ring in outline(polygon)
    )


def flat(polygon: shapely.Polygon, z: float, metres: float, normal: NDArray[np.float64] = UP) -> Mesh:
    """Return a level area seen from above whose texture repeats every `metres`."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    points = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.column_stack([points, np.full(len(points), z)])
    order = np.arange(len(points)).reshape(-1, 3)
    return make(vertices, np.broadcast_to(normal, vertices.shape), points / metres, order)


def hipped_roof(quadrilateral: shapely.Polygon, z: float, slope: float, metres: float) -> Mesh:
    """Return a roof over four corners that rises from every side at `slope` to a ridge along the longer axis."""
    corners = outline(quadrilateral)[0][:4]
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    if sides[0] + sides[2] < sides[1] + sides[3]:
        corners, sides = np.roll(corners, -1, axis=0), np.roll(sides, -1)
    half_width = (sides[1] + sides[3]) / 4
    middle_low, middle_high = (corners[3] + corners[0]) / 2, (corners[1] + corners[2]) / 2
    along = (middle_high - middle_low) / np.linalg.norm(middle_high - middle_low)
    ridge = [
        np.append(end, z + half_width * slope)
        for end in (middle_low + along * half_width, middle_high - along * half_width)
    ]
    a, b, c, d = (np.append(corner, z) for corner in corners)
    faces = np.array(
        [[a, b, ridge[1], ridge[0]], [b, c, ridge[1], ridge[1]], [c, d, ridge[0], ridge[1]], [d, a, ridge[0], ridge[0]]]
    )
    return quads(faces, _down_the_slope(faces) / metres)


def ball(centre: ArrayLike, radii: ArrayLike, detail: int, bumps: NDArray[np.float64] | None = None) -> Mesh:
    """Return an ellipsoid of `detail` rings and twice as many sectors; `bumps` (detail + 1, 2 detail + 1) scale it."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, detail + 1), np.linspace(0, 2 * np.pi, 2 * detail + 1), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    scaled = unit if bumps is None else unit * bumps[..., None]
    vertices = np.asarray(centre) + scaled * np.asarray(radii)
    normals = unit / np.asarray(radii)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uvs = np.stack([around / np.pi, polar / np.pi], axis=-1)
    return grid(vertices, normals, uvs)


def tube(start: ArrayLike, end: ArrayLike, radii: tuple[float, float], sectors: int = 8) -> Mesh:
    """Return an open tube between two points (3,), with a radius at either end; radius 0 makes a cone."""
    begin, finish = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = finish - begin
    length = float(np.linalg.norm(axis))
    axis /= length
    side = np.cross(axis, UP if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    around = np.linspace(0, 2 * np.pi, sectors + 1)
    spokes = np.cos(around)[:, None] * side + np.sin(around)[:, None] * np.cross(axis, side)
    vertices = np.stack([finish + radii[1] * spokes, begin + radii[0] * spokes])
    slanted = spokes + axis * (radii[0] - radii[1]) / length
    normals = np.broadcast_to(slanted / np.linalg.norm(slanted, axis=1, keepdims=True), vertices.shape)
    u = around / np.pi
    uvs = np.stack([np.column_stack([u, np.zeros_like(u)]), np.column_stack([u, np.full_like(u, length)])])
    return grid(vertices, normals, uvs)


def _running(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance along the ring at each wall's beginning and end, (k - 1, 2)."""
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    ends = np.cumsum(lengths)
    return np.stack([ends - lengths, ends], axis=1)


def _down_the_slope(faces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return texture coordinates (n, 4, 2) in metres along the eaves and up the slope of roof faces (n, 4, 3)."""
    eaves = faces[:, 1] - faces[:, 0]
    eaves /= np.linalg.norm(eaves, axis=1, keepdims=True)
    from_first = faces - faces[:, :1]
    along = np.einsum("nij,nj->ni", from_first, eaves)
    up = np.linalg.norm(from_first - along[..., None] * eaves[:, None], axis=-1)
    return np.stack([along, -up], axis=-1)
