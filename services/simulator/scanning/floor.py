"""Find the floor of a scan that a robot can drive on, and lay it level.

Samples of the surfaces fill columns of small cells. A robot can stand on a cell that faces up and
has room for the robot above it, and drives to neighbouring cells that are at most a climbable step
higher or lower. Each connected group of such cells is a floor: a storey, or a table top.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from services.simulator.robots import RobotModel
from services.simulator.scanning.faces import PartFaces
from services.simulator.scanning.mesh_file import ScanPart
from services.simulator.world.place import WorldError, polygons

# Width of a cell in radii of the robot, and number of cells in its climbable step.
_CELL: Final = 0.25
_CLIMB: Final = 3  # Cells.
# Mean number of samples in a cell that a surface crosses, and the number that makes it solid:
# specks are smaller than a cell.
_SAMPLES: Final = 8
_SOLID: Final = 2
_MOST_SAMPLES: Final = 60_000_000
# Samples that are in memory at once: some 500 MB with their triangles and cells.
_BLOCK: Final = 2_000_000
# Cosine of the steepest floor: scanned floors are bumpy.
_FACES_UP: Final = 0.6
# Gaps in the floor up to this many cells wide are closed.
_GAP: Final = 4
# Largest distance from the median of the surfaces, in cells; farther specks are outliers.
_FARTHEST: Final = 2500
_MARGIN: Final = 2 * _GAP  # Free cells around a scan.
# Cells (rows, columns) to which the robot drives: one gap of a cell is bridged.
_NEIGHBOURS: Final = ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2))
#: Least area of a floor.
LEAST_M2: Final = 2.0
# The lowest floor is chosen unless another one is larger by this factor: a ceiling is also level.
_LARGER: Final = 2.0
# A requested height differs from its floor by less than half a storey.
_FLOOR_M: Final = 1.0
# Floor heights are smoothed over this distance before the scan is laid level.
_SMOOTH_M: Final = 0.5


_NEVER: Final = np.iinfo(np.int64).max

Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Grade:
    """Height of a floor over the whole plan of a scan, which lays the scan level.

    Attributes
    ----------
    height_m : array of shape (rows, columns)
        Height in each cell.
    low : array of shape (2,)
        Corner of the first cell.
    cell_m : float
        Width of a cell.
    corner : array of shape (2,)
        Origin of the levelled scan.
    """

    height_m: NDArray[np.float64]
    low: NDArray[np.float64]
    cell_m: float
    corner: NDArray[np.float64]

    def levelled(self, parts: Sequence[ScanPart]) -> tuple[ScanPart, ...]:
        """Return the parts with the floor at height 0: verticals and the plan stay."""
        smooth = ndimage.gaussian_filter(self.height_m, _SMOOTH_M / self.cell_m, mode="nearest")
        found = []
        for part in parts:
            at = (part.vertices[:, :2] - self.low) / self.cell_m - 0.5
            below_m = ndimage.map_coordinates(smooth, at.T, order=1, mode="nearest")
            moved = part.vertices - np.column_stack([np.tile(self.corner, (len(at), 1)), below_m])
            found.append(replace(part, vertices=moved))
        return tuple(found)


@dataclass(frozen=True)
class FoundFloor:
    """A floor, metres of the scan laid level; x and y count from its south-west corner."""

    grade: Grade
    area: Polygon  # Area that the robot's body can cover.
    walls: MultiPolygon  # Solid cells at the height of the robot's camera.
    height_m: float  # Mean height in the scan.
    storeys: tuple[tuple[float, float], ...]  # Height and area of each floor, lowest first.
    holes: float  # Share of the area without a surface.
    open_edge: float  # Share of the edge without a wall or another obstacle.
    roofed: float  # Share of the area with a surface above the robot.


def find_floor(
    faces: Sequence[PartFaces],
    robot: RobotModel,
    height_m: float | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> FoundFloor:
    """Find the largest connected floor for a robot, or the floor nearest to a height.

    Parameters
    ----------
    faces : sequence of PartFaces
    robot : RobotModel
    height_m : float, optional
        Height of the floor in the scan, metres.
    progress : callable, optional
        Called with the number of samples of the surfaces that are done, and of all.

    Raises
    ------
    WorldError
        No floor is large enough, or none is near the height.
    """
    columns = _Columns(faces, robot, progress)
    storeys = columns.storeys()
    if not storeys:
        raise WorldError(
            f"no floor of {LEAST_M2:g} m2 or more with room for the robot (radius {robot.radius_m:g} m, "
            f"height {robot.top_m:g} m); check the unit and the up axis, or give --scale or --up"
        )
    if height_m is not None:
        chosen = min(storeys, key=lambda one: abs(one.height_m - height_m))
        if abs(chosen.height_m - height_m) > _FLOOR_M:
            found = ", ".join(f"{one.height_m:.2f}" for one in storeys)
            raise WorldError(
                f"--floor {height_m:g}: no floor within {_FLOOR_M:g} m of this height; "
                f"choose from {found} m"
            )
    else:
        largest = max(one.area_m2 for one in storeys)
        chosen = next(one for one in storeys if _LARGER * one.area_m2 >= largest)
    return columns.floor(chosen, tuple((one.height_m, one.area_m2) for one in storeys))


@dataclass(frozen=True, eq=False)
class _Storey:
    """Connected floor cells; `codes` are sorted."""

    codes: Cells
    height_m: float
    area_m2: float


def _middle(faces: Sequence[PartFaces]) -> NDArray[np.float64]:
    """Return the median (2,) of the surfaces in the plan: half of their area is on each side."""
    areas = np.concatenate([one.areas for one in faces])
    centres = np.concatenate([one.corners[..., :2].mean(axis=1) for one in faces])
    order = np.argsort(centres, axis=0)
    along = np.cumsum(areas[order], axis=0)
    half = [int(np.searchsorted(one, one[-1] / 2)) for one in along.T]
    return np.array([centres[order[k, axis], axis] for axis, k in enumerate(half)])


def _points_in(corners: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random point of each triangle (n, 3, 3)."""
    u, v = rng.random((2, len(corners), 1))
    outside = u + v > 1
    u = np.where(outside, 1 - u, u)
    v = np.where(outside, 1 - v, v)
    a, b, c = np.moveaxis(corners, 1, 0)
    return np.asarray(a + (b - a) * u + (c - a) * v)


class _Tally:
    """Counts how often each code occurs, in memory for the different codes."""

    def __init__(self) -> None:
        self._counted: list[tuple[Cells, Cells]] = []

    def add(self, codes: Cells) -> None:
        """Count some codes."""
        self._counted.append(np.unique(codes, return_counts=True))
        if sum(len(one) for one, _ in self._counted) > 4 * _BLOCK:
            self._join()

    def _join(self) -> None:
        codes, counts = (np.concatenate(one) for one in zip(*self._counted, strict=True))
        found, which = np.unique(codes, return_inverse=True)
        self._counted = [(found, np.bincount(which, counts).astype(np.int64))]

    def at_least(self, count: int) -> Cells:
        """Return the sorted codes that occur this often."""
        self._join()
        codes, counts = self._counted[0]
        return codes[counts >= count]


class _Columns:
    """Occupied cells of a scan; the code of a cell counts through its column first."""

    def __init__(
        self,
        faces: Sequence[PartFaces],
        robot: RobotModel,
        progress: Callable[[int, int], None],
    ) -> None:
        self._robot = robot
        self._cell_m = _CELL * robot.radius_m
        self._cell_height_m = robot.climb_m / _CLIMB
        self._top = math.ceil(robot.top_m / self._cell_height_m)
        size_m = np.array([self._cell_m, self._cell_m, self._cell_height_m])
        farthest_m = _FARTHEST * self._cell_m
        reach_m = np.array([farthest_m, farthest_m, math.inf])
        middle = np.append(_middle(faces), 0.0)
        self._from_m = middle - reach_m
        self._to_m = middle + reach_m
        low, high = self._bounds(faces)
        self._low = low - _MARGIN * size_m
        # Room above the highest cell, so that a search for the robot's height stays in its column.
        above = self._top + _CLIMB + 2
        highest = ((high - self._low) / size_m).astype(np.int64)
        rows, columns, heights = (highest + np.array([_MARGIN, _MARGIN, above])).tolist()
        self._plan = (rows, columns)
        self._heights = heights
        tally = _Tally()
        level: list[Cells] = []
        for points, faces_up in self._samples(faces, progress):
            cells = ((points - self._low) / size_m).astype(np.int64)
            codes = self._codes(cells[:, 0], cells[:, 1], cells[:, 2])
            tally.add(codes)
            level.append(np.unique(codes[faces_up]))
        self._solid = tally.at_least(_SOLID)
        floor = np.unique(np.concatenate(level))
        self._floor = floor[~self._hit(floor + _CLIMB, self._top)]

    def _bounds(
        self, faces: Sequence[PartFaces]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and the highest coordinates (3,) of the surfaces, without outliers."""
        lowest = np.concatenate([one.corners.min(axis=1) for one in faces])
        highest = np.concatenate([one.corners.max(axis=1) for one in faces])
        near = self._are_near(lowest, highest)
        low = np.maximum(lowest[near].min(axis=0), self._from_m)
        return low, np.minimum(highest[near].max(axis=0), self._to_m)

    def _are_near(
        self, lowest: NDArray[np.float64], highest: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return which boxes, given by their corners (n, 3), are not all among the outliers."""
        return np.asarray(((lowest < self._to_m) & (highest > self._from_m)).all(axis=1))

    def _samples(
        self, faces: Sequence[PartFaces], progress: Callable[[int, int], None]
    ) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
        """Yield random points (n, 3) of the surfaces, and whether they face up; without outliers."""
        rng = np.random.default_rng(0)
        density = _SAMPLES / (self._cell_m * min(self._cell_m, self._cell_height_m))
        density = min(density, _MOST_SAMPLES / sum(float(one.areas.sum()) for one in faces))
        counts = [rng.poisson(one.areas * density) for one in faces]
        total = sum(int(one.sum()) for one in counts)
        done = 0
        for one, samples in zip(faces, counts, strict=True):
            ends = np.cumsum(samples)
            count = int(samples.sum())
            up = one.normals[:, 2]
            faces_up = (np.abs(up) if one.both else up) > _FACES_UP
            for start in range(0, count, _BLOCK):
                progress(done + start, total)
                number = np.arange(start, min(start + _BLOCK, count))
                which = np.searchsorted(ends, number, side="right")
                points = _points_in(one.corners[which], rng)
                near = self._are_near(points, points)
                yield points[near], faces_up[which[near]]
            done += count
        progress(total, total)

    def _codes(self, i: Cells, j: Cells, k: Cells) -> Cells:
        return np.asarray((i * self._plan[1] + j) * self._heights + k)

    def _hit(self, codes: Cells, above: int | Cells) -> NDArray[np.bool_]:
        """Return whether a solid cell lies 1 to `above` cells above each cell."""
        return np.asarray(_next(self._solid, codes + 1) <= codes + above)

    def storeys(self) -> list[_Storey]:
        """Return the connected floors of at least `LEAST_M2`, the lowest first."""
        count = len(self._floor)
        pairs = []
        for i, j in _NEIGHBOURS:
            beside = self._floor + (i * self._plan[1] + j) * self._heights
            at = np.searchsorted(self._floor, beside - _CLIMB if (i, j) != (0, 0) else beside + 1)
            near = np.append(self._floor, _NEVER)[at] <= beside + _CLIMB
            pairs.append(np.stack([np.flatnonzero(near), at[near]]))
        rows, columns = np.concatenate(pairs, axis=1)
        graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), (count, count))
        _, group = connected_components(graph, directed=False)
        ends = np.cumsum(np.bincount(group))[:-1]
        groups = np.split(self._floor[np.argsort(group, kind="stable")], ends)
        found = [self._storey(codes) for codes in groups if len(codes)]
        large = [one for one in found if one.area_m2 >= LEAST_M2]
        return sorted(large, key=lambda one: one.height_m)

    def _storey(self, codes: Cells) -> _Storey:
        area_m2 = len(np.unique(codes // self._heights)) * self._cell_m**2
        return _Storey(codes, float(np.median(self._height_m(codes % self._heights))), area_m2)

    def _height_m(self, k: Cells) -> NDArray[np.float64]:
        return np.asarray(self._low[2] + (k + 0.5) * self._cell_height_m)

    def floor(self, storey: _Storey, storeys: tuple[tuple[float, float], ...]) -> FoundFloor:
        """Return the largest part of a storey that the robot's body fits in."""
        known, k = self._plan_of(storey)
        i, j = np.indices(self._plan)
        base = self._codes(i, j, k)
        blocked = self._hit(base + _CLIMB, self._top)
        closed = ndimage.binary_closing(
            known, iterations=_GAP // 2, structure=np.ones((3, 3), dtype=np.bool_)
        )
        inside = self._reached((known | closed) & ~blocked)
        if not inside.any():
            raise WorldError(
                f"the floor at {storey.height_m:.2f} m has no room for the robot "
                f"(radius {self._robot.radius_m:g} m)"
            )
        rim = ndimage.binary_dilation(inside, iterations=2) & ~inside
        fenced = ndimage.binary_dilation(blocked, iterations=3)
        roofed = self._hit(base + self._top, self._heights - 1 - k - self._top)
        camera = round(self._robot.camera.height_m / self._cell_height_m)
        opaque = self._hit(base + camera - _CLIMB, 2 * _CLIMB) & ~inside
        area = max(polygons(self._outline(inside)), key=lambda one: one.area)
        corner = np.array(area.bounds[:2])
        walls = polygons(self._outline(opaque), self._cell_m**2)
        return FoundFloor(
            grade=Grade(self._height_m(k), self._low[:2], self._cell_m, corner),
            area=shapely.transform(area, lambda xy: xy - corner),
            walls=shapely.transform(MultiPolygon(walls), lambda xy: xy - corner),
            height_m=storey.height_m,
            storeys=storeys,
            holes=_share(~known, inside),
            open_edge=_share(~fenced, rim),
            roofed=_share(roofed, inside),
        )

    def _plan_of(self, storey: _Storey) -> tuple[NDArray[np.bool_], Cells]:
        """Return which columns have the floor, and its height in every column, continued."""
        known = np.zeros(self._plan, dtype=np.bool_)
        k = np.zeros(self._plan, dtype=np.int64)
        downwards = storey.codes[::-1]  # The lowest cell of a column is set last.
        known.flat[downwards // self._heights] = True
        k.flat[downwards // self._heights] = downwards % self._heights
        nearest = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        return known, k[tuple(nearest)]

    def _reached(self, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the largest connected area that the robot's body can cover."""
        radius = self._robot.radius_m / self._cell_m
        groups, count = ndimage.label(ndimage.distance_transform_edt(free) >= radius)
        if count == 0:
            return np.zeros_like(free)
        centre = groups == np.bincount(groups.ravel())[1:].argmax() + 1
        return np.asarray(ndimage.distance_transform_edt(~centre) < radius)

    def _outline(self, cells: NDArray[np.bool_]) -> BaseGeometry:
        """Return the area of cells, with straightened edges."""
        edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        # Whole numbers, so that strips meet exactly.
        whole = shapely.union_all(shapely.box(row, begin, row + 1, end)).simplify(1.0)
        return shapely.transform(whole, lambda xy: self._low[:2] + xy * self._cell_m)


def _next(codes: Cells, least: Cells) -> Cells:
    """Return the first of the sorted codes that is at least each value, or `_NEVER`."""
    return np.asarray(np.append(codes, _NEVER)[np.searchsorted(codes, least)])


def _share(what: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float((what & of).sum() / max(of.sum(), 1))
