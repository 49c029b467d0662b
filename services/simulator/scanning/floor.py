"""Find the floor of a scan that a robot can drive on, and lay it level.

Samples of the surfaces fill columns of small cells. A robot can stand on a cell that faces up and
has room for the robot above it, and drives to neighbouring cells that are at most a climbable step
higher or lower. Each connected group of such cells is a floor: a storey, or a table top.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely import MultiPolygon, Polygon

from services.simulator.robots import RobotModel
from services.simulator.scanning.mesh_file import Part
from services.simulator.world.place import WorldError, polygons

# Cells are this share of the robot's radius wide, and of its climbable step high.
_CELL: Final = 0.25
_CELL_HEIGHT: Final = 1 / 3
# Mean number of samples in a cell that a surface crosses, and the number that makes it solid:
# specks are smaller than a cell.
_SAMPLES: Final = 8
_SOLID: Final = 2
_MOST_SAMPLES: Final = 60_000_000
# Cosine of the steepest floor: scanned floors are bumpy.
_FACES_UP: Final = 0.6
# Gaps in the floor up to this many cells wide are closed.
_GAP: Final = 4
#: Least area of a floor.
LEAST_M2: Final = 2.0
# The lowest floor is chosen unless another one is larger by this factor: a ceiling is also level.
_LARGER: Final = 2.0
# Floor heights are smoothed over this distance before the scan is laid level.
_SMOOTH_M: Final = 0.5


@dataclass(frozen=True)
class FoundFloor:
    """A floor, metres of the scan laid level; x and y count from its south-west corner."""

    parts: tuple[Part, ...]
    area: Polygon  # Area that the robot's body can cover.
    walls: MultiPolygon  # Solid cells at the height of the robot's camera.
    height_m: float  # Mean height in the scan.
    storeys: tuple[tuple[float, float], ...]  # Height and area of each floor, lowest first.
    holes: float  # Share of the area without a surface.
    open_edge: float  # Share of the edge without a wall or another obstacle.
    roofed: float  # Share of the area with a surface above the robot.


def find_floor(
    parts: Sequence[Part], robot: RobotModel, height_m: float | None = None
) -> FoundFloor:
    """Find the largest connected floor for a robot, or the floor nearest to a height.

    Raises
    ------
    WorldError
        No floor is large enough.
    """
    columns = _Columns(parts, robot)
    storeys = columns.storeys()
    if not storeys:
        raise WorldError(
            f"no floor of {LEAST_M2:g} m2 or more with room for the robot (radius {robot.radius_m:g} m, "
            f"height {robot.top_m:g} m); check the unit and the up axis, or give --scale or --up"
        )
    if height_m is not None:
        chosen = min(storeys, key=lambda one: abs(one.height_m - height_m))
    else:
        largest = max(one.area_m2 for one in storeys)
        chosen = next(one for one in storeys if _LARGER * one.area_m2 >= largest)
    return columns.floor(chosen, tuple((one.height_m, one.area_m2) for one in storeys))


@dataclass(frozen=True, eq=False)
class _Storey:
    """Connected floor cells; `codes` are sorted."""

    codes: NDArray[np.int64]
    height_m: float
    area_m2: float


class _Columns:
    """Occupied cells of a scan; the code of a cell counts through its column first."""

    def __init__(self, parts: Sequence[Part], robot: RobotModel) -> None:
        self._parts = parts
        self._robot = robot
        self._cell_m = _CELL * robot.radius_m
        self._cell_height_m = _CELL_HEIGHT * robot.climb_m
        self._climb = round(robot.climb_m / self._cell_height_m)
        self._top = int(np.ceil(robot.top_m / self._cell_height_m))
        points, faces_up = self._samples()
        self._low = points.min(axis=0) - self._margin_m
        cells = ((points - self._low) / self._size_m).astype(np.int64)
        # Room above the highest cell, so that a search stays in its column.
        self._shape = cells.max(axis=0) + (self._margin, self._margin, self._top + self._climb + 2)
        codes = self._codes(*cells.T)
        occupied, counts = np.unique(codes, return_counts=True)
        self._solid = occupied[counts >= _SOLID]
        level = np.unique(codes[faces_up])
        self._floor = level[~self._hit(level + self._climb, self._top)]

    @property
    def _margin(self) -> int:
        return 2 * _GAP

    @property
    def _margin_m(self) -> NDArray[np.float64]:
        return self._margin * self._size_m * (1, 1, 1)

    @property
    def _size_m(self) -> NDArray[np.float64]:
        return np.array([self._cell_m, self._cell_m, self._cell_height_m])

    def _samples(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return random points (n, 3) of the surfaces, and whether they face up."""
        rng = np.random.default_rng(0)
        corners = [part.vertices[part.triangles] for part in self._parts]
        normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) / 2 for c in corners]
        areas = [np.linalg.norm(normal, axis=1) for normal in normals]
        whole_m2 = sum(float(area.sum()) for area in areas)
        density = _SAMPLES / (self._cell_m * min(self._cell_m, self._cell_height_m))
        density = min(density, _MOST_SAMPLES / whole_m2)
        points = []
        ups = []
        for part, corner, normal, area in zip(self._parts, corners, normals, areas, strict=True):
            which = np.repeat(np.arange(len(area)), rng.poisson(area * density))
            u, v = rng.random((2, len(which), 1))
            outside = u + v > 1
            u = np.where(outside, 1 - u, u)
            v = np.where(outside, 1 - v, v)
            a, b, c = np.moveaxis(corner[which], 1, 0)
            points.append(a + (b - a) * u + (c - a) * v)
            up = normal[:, 2] / np.maximum(area, 1e-12)
            ups.append((np.abs(up) if part.both else up)[which] > _FACES_UP)
        return np.concatenate(points), np.concatenate(ups)

    def _codes(
        self, i: NDArray[np.int64], j: NDArray[np.int64], k: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        return (i * self._shape[1] + j) * self._shape[2] + k

    def _hit(self, codes: NDArray[np.int64], above: int) -> NDArray[np.bool_]:
        """Return whether a solid cell lies 1 to `above` cells above each cell."""
        after = np.searchsorted(self._solid, codes, side="right")
        return np.append(self._solid, np.iinfo(np.int64).max)[after] <= codes + above

    def storeys(self) -> list[_Storey]:
        """Return the connected floors of at least `LEAST_M2`, the lowest first."""
        count = len(self._floor)
        pairs = []
        for i, j in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2)):
            step = (i * self._shape[1] + j) * self._shape[2]
            lowest = self._floor + step - self._climb if step else self._floor + 1
            at = np.searchsorted(self._floor, lowest)
            near = (
                np.append(self._floor, np.iinfo(np.int64).max)[at]
                <= self._floor + step + self._climb
            )
            pairs.append(np.stack([np.flatnonzero(near), at[near]]))
        rows, columns = np.concatenate(pairs, axis=1)
        graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), (count, count))
        _, group = connected_components(graph, directed=False)
        order = np.argsort(group, kind="stable")
        found = [
            self._storey(codes)
            for codes in np.split(self._floor[order], np.cumsum(np.bincount(group))[:-1])
        ]
        return sorted(
            (one for one in found if one.area_m2 >= LEAST_M2), key=lambda one: one.height_m
        )

    def _storey(self, codes: NDArray[np.int64]) -> _Storey:
        area_m2 = len(np.unique(codes // self._shape[2])) * self._cell_m**2
        heights = self._low[2] + (codes % self._shape[2] + 0.5) * self._cell_height_m
        return _Storey(codes, float(np.median(heights)) if len(codes) else 0.0, area_m2)

    def floor(self, storey: _Storey, storeys: tuple[tuple[float, float], ...]) -> FoundFloor:
        """Return the largest part of a storey that the robot's body fits in."""
        rows, columns, _ = self._shape.tolist()
        known = np.zeros((rows, columns), dtype=np.bool_)
        cell = np.zeros((rows, columns), dtype=np.int64)
        column = storey.codes[::-1] // self._shape[2]  # The lowest cell of a column is set last.
        known.flat[column] = True
        cell.flat[column] = storey.codes[::-1] % self._shape[2]
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        cell = cell[tuple(nearest)]
        base = self._codes(*np.indices((rows, columns)), cell)
        blocked = self._hit(base + self._climb, self._top)
        closed = ndimage.binary_closing(known, iterations=_GAP // 2, structure=np.ones((3, 3)))
        free = (known | closed) & ~blocked
        clear_m = ndimage.distance_transform_edt(free) * self._cell_m
        groups, count = ndimage.label(clear_m >= self._robot.radius_m)
        if count == 0:
            raise WorldError(
                f"the floor at {storey.height_m:.2f} m has no room for the robot (radius {self._robot.radius_m:g} m)"
            )
        centre = groups == np.bincount(groups.ravel())[1:].argmax() + 1
        inside = ndimage.distance_transform_edt(~centre) * self._cell_m < self._robot.radius_m
        rim = ndimage.binary_dilation(inside, iterations=2) & ~inside
        fenced = ndimage.binary_dilation(blocked, iterations=3)
        camera = round(self._robot.camera.height_m / self._cell_height_m)
        above = self._hit(base + self._top, int(self._shape[2]) - self._top)
        above &= self._next_in_column(base + self._top)
        area = max(polygons(self._outline(inside)), key=lambda one: one.area)
        origin = np.array([*area.bounds[:2], 0.0])
        walls = self._outline(self._hit(base + camera - self._climb, 2 * self._climb) & ~inside)
        heights_m = self._low[2] + (cell + 0.5) * self._cell_height_m
        return FoundFloor(
            parts=tuple(self._level(heights_m, origin)),
            area=shapely.transform(area, lambda xy: xy - origin[:2]),
            walls=MultiPolygon(
                polygons(shapely.transform(walls, lambda xy: xy - origin[:2]), self._cell_m**2)
            ),
            height_m=storey.height_m,
            storeys=storeys,
            holes=float((inside & ~known).sum() / inside.sum()),
            open_edge=float((rim & ~fenced).sum() / max(rim.sum(), 1)),
            roofed=float((above & inside).sum() / inside.sum()),
        )

    def _next_in_column(self, codes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether the next solid cell above is in the same column."""
        after = np.searchsorted(self._solid, codes, side="right")
        found = np.append(self._solid, -1)[after]
        return found // self._shape[2] == codes // self._shape[2]

    def _outline(self, cells: NDArray[np.bool_]) -> shapely.Geometry:
        """Return the area of cells, with straightened edges."""
        edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        # Whole numbers, so that strips meet exactly.
        whole = shapely.union_all(shapely.box(row, begin, row + 1, end)).simplify(1.0)
        return shapely.transform(whole, lambda xy: self._low[:2] + xy * self._cell_m)

    def _level(self, heights_m: NDArray[np.float64], origin: NDArray[np.float64]) -> list[Part]:
        """Return the parts with the floor at height 0: verticals and the plan stay."""
        smooth = ndimage.gaussian_filter(heights_m, _SMOOTH_M / self._cell_m, mode="nearest")
        found = []
        for part in self._parts:
            at = (part.vertices[:, :2] - self._low[:2]) / self._cell_m - 0.5
            floor_m = ndimage.map_coordinates(smooth, at.T, order=1, mode="nearest")
            vertices = part.vertices - origin
            vertices[:, 2] -= floor_m
            found.append(replace(part, vertices=vertices))
        return found
