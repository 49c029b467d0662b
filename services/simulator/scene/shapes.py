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


def sides(ring: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return the upright rectangles (k - 1, 4, 3) along a closed ring (k, 2), from one height to another.

    Each from its foot on, anticlockwise seen from the right of the ring.
    """
    begin, end = ring[:-1], ring[1:]
    foot, top = np.full((len(begin), 1), low), np.full((len(begin), 1), high)
    return np.stack(
        [np.hstack([begin, foot]), np.hstack([end, foot]), np.hstack([end, top]), np.hstack([begin, top])], axis=1
    )


def walls(
    ring: NDArray[np.float64],
    low: float,
    high: float,
    u: NDArray[np.float64],
    v: tuple[float, float],
    which: NDArray[np.bool_] | None = None,
) -> Mesh:
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
    which
        (k - 1,) of which sides to make walls; None for all.
    """
    chosen = np.ones(len(u), dtype=bool) if which is None else which
    corners, u = sides(ring, low, high)[chosen], u[chosen]
    low_v, high_v = (np.full(len(corners), value) for value in v)
    coordinates = [(u[:, 0], low_v), (u[:, 1], low_v), (u[:, 1], high_v), (u[:, 0], high_v)]
    return quads(corners, np.stack([np.stack(pair, axis=1) for pair in coordinates], axis=1))


def band(polygon: shapely.Polygon, low: float, high: float, metres: float) -> Mesh:
    """Return plain walls around a polygon whose texture repeats every `metres`."""
    return merge(
        walls(ring, low, high, running(ring) / metres, (high / metres, low / metres)) for ring in outline(polygon)
    )


def flat(polygon: shapely.Polygon, z: float, metres: float, normal: NDArray[np.float64] = UP) -> Mesh:
    """Return a level area seen from above whose texture repeats every `metres`."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    points = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.column_stack([points, np.full(len(points), z)])
    order = np.arange(len(points)).reshape(-1, 3)
    return make(vertices, np.broadcast_to(normal, vertices.shape), points / metres, order)


def ridged(
    corners: NDArray[np.float64], z: float, rise: float, run: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the triangles of a roof over a rectangle with a ridge along its first side.

    Parameters
    ----------
    corners
        (4, 2) anticlockwise, the first side along the ridge.
    z, rise
        Height of the eaves, and of the ridge above them.
    run
        How far the ridge ends before the short sides, at most half the first side; 0 makes upright ends.

    Returns
    -------
    slopes, ends
        (4, 3, 3) of the long sides and (2, 3, 3) of the short ones, anticlockwise seen from outside.
    """
    a, b, c, d = (np.append(corner, z) for corner in corners)
    along = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    first, last = (
        np.append((corners[0] + corners[3]) / 2 + run * along, z + rise),
        np.append((corners[1] + corners[2]) / 2 - run * along, z + rise),
    )
    slopes = np.array([[a, b, last], [a, last, first], [c, d, first], [c, first, last]])
    return slopes, np.array([[b, c, last], [d, a, first]])


def faces(triangles: NDArray[np.float64], metres: tuple[float, float]) -> Mesh:
    """Return flat triangles (n, 3, 3), anticlockwise seen from outside, that wear a texture upright.

    The texture repeats every `metres` along the level and up the slope. A triangle without area is left out.
    """
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice_area = np.linalg.norm(across, axis=1)
    solid = twice_area > 1e-9
    corners, normal = triangles[solid], across[solid] / twice_area[solid, None]
    level = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    tilt = np.linalg.norm(level, axis=1, keepdims=True)
    level = np.where(tilt > 1e-6, level / np.maximum(tilt, 1e-6), (1.0, 0.0, 0.0))
    up = np.cross(normal, level)
    uvs = np.stack([np.einsum("nij,nj->ni", corners, level), -np.einsum("nij,nj->ni", corners, up)], axis=-1)
    order = np.arange(3 * len(corners)).reshape(-1, 3)
    return make(corners.reshape(-1, 3), np.repeat(normal, 3, axis=0), uvs.reshape(-1, 2) / metres, order)


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


def running(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance along the ring at each wall's beginning and end, (k - 1, 2)."""
    lengths = np.linalg.norm(np.diff(ring, axis=0), axis=1)
    ends = np.cumsum(lengths)
    return np.stack([ends - lengths, ends], axis=1)
