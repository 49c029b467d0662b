"""Occupancy grid around the robot from a depth camera: free, occupied or unknown cells.

Each image becomes a scan: for every column, the free ground and the distance of the nearest
obstacle. Ground is the plane below the camera. The mount gives its height, and each image its pitch
and roll. Scans accumulate in a grid that moves with the robot by its odometry, so that areas out of
view stay known. Only observed space is free: an image without depth changes nothing, and unknown
cells are not free.
"""

import copy
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from smal.arrays import Bools, Float32s, Floats, Indices
from smal.obstacles.occupancy import GRID_CONFIG, CellEvidence, Occupancy


class Mount(NamedTuple):
    """Mount of a level depth camera on a round robot that turns on the spot."""

    #: Focal length over the image's width; the axis meets the middle of the image.
    focal: float
    #: Height of the camera above the ground.
    height_m: float
    #: Distance of the camera ahead of the middle of the robot.
    ahead_m: float
    #: Radius of the robot.
    radius_m: float
    #: Height of the robot.
    top_m: float


class Scan(NamedTuple):
    """Result of one depth image for each column; distances are along the camera's axis."""

    #: (n,) offset of the column to the left, a metre ahead; evenly spaced, from left to right.
    across: Floats
    #: (n,) distance of free ground.
    free_m: Floats
    #: (n,) distance of the nearest obstacle; infinite without any.
    hit_m: Floats
    #: (n,) visible height of the obstacle.
    top_m: Floats
    #: Fall of the lowest rays a metre: nearer objects can be below them.
    falls: float

    def least_m(self, ahead_m: Floats) -> Floats:
        """Return the height above the ground from which on the image shows obstacles."""
        pixel = self.across[0] - self.across[1]
        rises = GRID_CONFIG.ground_slope + (GRID_CONFIG.least_pixels - 1) * pixel
        return np.asarray(GRID_CONFIG.ground_m + rises * ahead_m)


def above_ground(up_m: Floats, ahead_m: Floats) -> Bools:
    """Return which points are above the ground, by their height over its plane and distance."""
    return up_m > GRID_CONFIG.ground_m + GRID_CONFIG.ground_slope * ahead_m


def rays(shape: tuple[int, ...], every: int, focal: float) -> tuple[Floats, Floats]:
    """Return the fall of every such row, and the offset of the columns to the left, a metre ahead.

    Parameters
    ----------
    shape : (height, width)
    every : int
        Step of the rows ``[every // 2 :: every]``, and of the columns.
    focal : float
        As in `Mount`.
    """
    focal_px = focal * shape[1]
    rows, columns = (np.arange(every // 2, size, every) + 0.5 - size / 2 for size in shape)
    return np.asarray(rows / focal_px), np.asarray(-columns / focal_px)


def thinned(depth_m: Float32s) -> tuple[Float32s, int]:
    """Return some rows and columns of a depth image (h, w), and the step from each to the next."""
    every = max(1, math.ceil(depth_m.shape[1] / GRID_CONFIG.depth_columns))
    return depth_m[every // 2 :: every, every // 2 :: every], every


def scan(depth_m: Float32s, mount: Mount) -> Scan | None:
    """Return the scan of a depth image (h, w) in metres (0 = missing).

    The mount gives the distance of the ground in the lowest rows of every column. A column shows
    that ground, or an obstacle before it. If most columns show neither, the camera is blind,
    differs from its mount, or is at an edge. The scan is then None.
    """
    some_m, every = thinned(depth_m)
    ahead = np.asarray(some_m, dtype=np.float64)
    if ahead.shape[0] < 2 * GRID_CONFIG.least_pixels or ahead.shape[1] < 2:
        return None  # Too few rows to distinguish ground from obstacles.
    valid = np.isfinite(ahead) & (ahead > 0.0)
    ahead = np.where(valid, ahead, 0.0)
    below, across = rays(depth_m.shape, every, mount.focal)
    up = mount.height_m - ahead * below[:, None]
    pitch, roll = _tilt(ahead, across, up, valid)
    up -= ahead * (pitch + roll * across)
    # An obstacle that hangs a little higher than the robot can hang lower beside its visible part.
    thing = valid & above_ground(up, ahead) & (up < mount.top_m + mount.radius_m)
    nearest = np.partition(np.where(thing, ahead, np.inf), GRID_CONFIG.least_pixels - 1, axis=0)
    hit_m = nearest[GRID_CONFIG.least_pixels - 1]
    top_m = np.where(thing & (ahead < hit_m + mount.radius_m), up, 0.0).max(axis=0)
    ground = valid & ~above_ground(np.abs(up), ahead)
    free_m = np.minimum(_ground_m(ahead, ground), hit_m)
    hides = _hides_ground(ahead, valid, below)
    hides &= hit_m * (below[-2 * GRID_CONFIG.least_pixels] + pitch) <= mount.height_m
    free_m = np.where(hides, hit_m, free_m)
    shown = float(np.median(free_m)) > 0.0
    return Scan(across, free_m, hit_m, top_m, float(below[-1]) + pitch) if shown else None


def _ground_m(ahead: Floats, ground: Bools) -> Floats:
    """Return the distance up to which each column shows ground; small gaps do not count."""
    gaps = np.cumsum(~ground[::-1], axis=0)[::-1]
    goes_on = ground & (gaps < 2 * GRID_CONFIG.least_pixels)
    return np.asarray(np.where(goes_on, ahead, 0.0).max(axis=0))


def _hides_ground(ahead: Floats, valid: Bools, below: Floats) -> Bools:
    """Return the columns whose lowest rows show the face of an obstacle, at any height.

    From row to row, a face does not recede as ground does. Up to a face the rays met nothing.
    """
    upper = -2 * GRID_CONFIG.least_pixels
    recedes = below[-1] / below[upper]
    face = ahead[upper] < ahead[-1] * (1.0 + recedes) / 2.0
    return np.asarray(face & valid[-1] & valid[upper])


def _tilt(ahead: Floats, across: Floats, up: Floats, valid: Bools) -> Floats:
    """Return the slope of the ground ahead and to the left, relative to the camera."""
    tilt = np.zeros(2)
    most_tilt = math.tan(math.radians(GRID_CONFIG.tilt_deg))
    sides = np.broadcast_to(across, ahead.shape)
    for slope in (most_tilt, most_tilt / 3.0):
        off_m = np.abs(up - (tilt[0] + tilt[1] * across) * ahead)
        flat = valid & (off_m < GRID_CONFIG.ground_m / 2.0 + slope * ahead)
        if flat.sum() < valid.size // 50:
            break
        # The error of a point grows with its distance.
        a_metre = np.stack([np.ones(int(flat.sum())), sides[flat]])
        rises = a_metre @ (up[flat] / ahead[flat])
        tilt = np.linalg.lstsq(a_metre @ a_metre.T, rises, rcond=None)[0]
        tilt = tilt.clip(-most_tilt, most_tilt)
    return tilt


class Surroundings:
    """Occupancy grid that moves with a round robot.

    It holds what depth images show, and what the robot has touched: a robot without a depth camera
    has the second alone. Its axes are the axes of the odometry. Cells are (x, y); the robot is in the middle cell.

    Attributes
    ----------
    cell_m, reach_m
        Size of a cell, and reach of the grid.
    body_m
        Distance that the robot keeps from the middle of an occupied cell. The obstacle fills half
        of the cell; the other half is for wheels that slip.
    heading
        Heading by the odometry.
    has_camera
        Whether the robot has a depth camera, which need not see.
    seen
        Scan of the last image; None if it showed no ground.
    """

    def __init__(self, radius_m: float) -> None:
        self.radius_m = radius_m
        self.cell_m = radius_m / GRID_CONFIG.cells_radius
        self.reach_m = GRID_CONFIG.reach * radius_m
        self.body_m = radius_m + self.cell_m
        self._half = GRID_CONFIG.cells_radius * GRID_CONFIG.reach
        offsets = np.arange(-self._half, self._half + 1) * self.cell_m
        #: Offset of each cell's middle from the middle of the robot's cell.
        self._x_m, self._y_m = np.meshgrid(offsets, offsets, indexing="ij")
        self._grid = Occupancy(offsets.size)
        self._cell: tuple[int, int] | None = None
        self._rest = np.zeros(2)
        #: Odometry positions (n, 2) that the robot has touched.
        self._touched = np.zeros((0, 2))
        self._mount: Mount | None = None  # Mount at the last image.
        self.heading = 0.0
        self.has_camera = False
        self.seen: Scan | None = None

    def snapshot(self) -> Self:
        """Return an independent copy for another thread."""
        made = copy.copy(self)
        made._grid = copy.deepcopy(self._grid)
        return made

    def move(self, pose: Sequence[float]) -> None:
        """Move to the odometry pose: x, y and heading in radians."""
        x, y, self.heading = pose
        cell = round(x / self.cell_m), round(y / self.cell_m)
        before = self._cell or cell
        self._cell = cell
        self._rest = np.array([x, y]) - np.multiply(cell, self.cell_m)
        self._forget()
        self._grid.shift((before[0] - cell[0], before[1] - cell[1]))
        under_m = self.radius_m - self.cell_m / 2.0
        self._grid.assume(self.away_m < under_m, occupied=False, height_m=0.0)
        # Where the robot stands there is nothing any more.
        away_m = np.hypot(*(self._touched - (x, y)).T)
        self._touched = self._touched[(away_m >= under_m) & (away_m < self.reach_m)]

    def touch(self) -> int:
        """Add an obstacle before the robot, and return how many the robot has touched here.

        The place of contact is unknown. It counts as straight ahead, and as small: if it is aside,
        the robot touches it again on one way around, and takes the other.
        """
        here = np.multiply(self._cell or (0, 0), self.cell_m) + self._rest
        towards = np.array([math.cos(self.heading), math.sin(self.heading)])
        self._touched = np.vstack([self._touched, here + self.body_m * towards])
        self._forget()
        return len(self._touched)

    def release(self) -> None:
        """Forget what the robot has touched: it can have left."""
        self._touched = self._touched[:0]
        self._forget()

    def _forget(self) -> None:
        """Forget the properties that follow from the layers and the pose."""
        for name, value in vars(type(self)).items():
            if isinstance(value, cached_property):
                self.__dict__.pop(name, None)

    def observe(
        self,
        pose: Sequence[float],
        depth_m: Float32s | None,
        mount: Mount,
        elapsed_s: float = 0.1,
    ) -> bool:
        """Move to the odometry pose, and add a depth image; return whether it contains a scan.

        ``elapsed_s`` is the time since the image before, seconds; a longer gap counts as a second.
        """
        self.move(pose)
        self.has_camera = True
        self.seen = None if depth_m is None else scan(depth_m, mount)
        if self.seen is None:
            return False
        self._mount = mount
        ahead, left = self.in_robot_axes(mount.ahead_m)
        column, inside = self._columns(self.seen, ahead, left)
        cells, hits = self._hits(self.seen, mount)
        top_m = np.zeros(ahead.shape)
        np.maximum.at(top_m, (cells[0][hits], cells[1][hits]), self.seen.top_m[hits])
        passed = inside & (ahead < self.seen.free_m[column] - self.cell_m / 2.0)
        lowest_m = mount.height_m - ahead * self.seen.falls
        evidence = CellEvidence(
            hit=top_m > 0.0,
            passed=passed,
            top_m=top_m,
            lowest_m=lowest_m,
            least_m=np.maximum(self.seen.least_m(ahead), lowest_m),
            elapsed_s=min(max(elapsed_s, 0.0), 1.0),
        )
        # Next to the robot, where the camera does not look, people can stand still.
        self._grid.add(evidence, self._beside_view)
        # A standing obstacle continues behind its face, about as far as the robot is wide.
        behind_m = ahead - self.seen.hit_m[column]
        hidden = inside & (behind_m > 0.0) & (behind_m < 2.0 * self.radius_m)
        new = self._grid.stood_less(GRID_CONFIG.stands_s)
        hidden &= self._grid.unknown & ~new[cells][column]
        self._grid.assume(hidden, occupied=True, height_m=self.seen.top_m[column[hidden]])
        self._forget()
        return True

    def _columns(self, seen: Scan, ahead: Floats, left: Floats) -> tuple[Indices, Bools]:
        """Return the column of a scan that shows each cell, and whether the scan shows the cell."""
        across = left / np.maximum(ahead, self.cell_m)
        column = np.rint((seen.across[0] - across) / (seen.across[0] - seen.across[1]))
        inside = (ahead > 0.0) & (column >= 0) & (column < seen.across.size)
        return np.where(inside, column, 0).astype(np.intp), inside

    def _hits(self, seen: Scan, mount: Mount) -> tuple[tuple[Indices, Indices], Bools]:
        """Return the cell that each column of a scan hits, and whether it is in the grid."""
        hit_m = np.minimum(seen.hit_m, 2.0 * self.reach_m)
        places = np.stack([mount.ahead_m + hit_m, hit_m * seen.across], axis=1)
        return self.cells(places), np.hypot(*places.T) < self.reach_m - self.cell_m

    @property
    def _beside_view(self) -> Bools:
        """Cells beside the robot, nearer than the camera's view is as wide as the robot."""
        if self._mount is None:
            return np.zeros(self._x_m.shape, dtype=np.bool_)
        ahead, left = self.in_robot_axes(self._mount.ahead_m)
        widens = 2.0 * self._mount.focal
        near = self.away_m < self._mount.ahead_m + widens * self.radius_m
        # Half of a cell can lie out of view.
        return near & (widens * (np.abs(left) + self.cell_m / 2.0) > ahead)

    def in_robot_axes(self, ahead_m: float) -> tuple[Floats, Floats]:
        """Return each cell's distance ahead and left of a place ahead of the robot's middle."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        dx = self._x_m - self._rest[0]
        dy = self._y_m - self._rest[1]
        return dx * cos + dy * sin - ahead_m, dy * cos - dx * sin

    def cells(self, places: Floats) -> tuple[Indices, Indices]:
        """Return the cells of places (..., 2) ahead and left of the robot, clipped to the grid."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        xy = self._rest + places @ np.array([[cos, sin], [-sin, cos]])
        half = self._half
        cells = np.rint(xy / self.cell_m).clip(-half, half).astype(np.intp) + half
        return cells[..., 0], cells[..., 1]

    @cached_property
    def away_m(self) -> Floats:
        """Distance of each cell's middle from the robot's middle."""
        return np.asarray(np.hypot(*self.in_robot_axes(0.0)))

    @cached_property
    def occupied(self) -> Bools:
        """Cells with an obstacle."""
        occupied = self._grid.occupied
        cells = np.rint(self._touched / self.cell_m).astype(np.intp) - (self._cell or (0, 0))
        near = cells[np.abs(cells).max(axis=1, initial=0) <= self._half] + self._half
        occupied[near[:, 0], near[:, 1]] = True
        return occupied

    @property
    def unknown(self) -> Bools:
        """Cells that were never seen."""
        return self._grid.unknown

    @cached_property
    def new(self) -> Bools:
        """Cells of obstacles that appeared in free space within the last seconds."""
        return self._newer(GRID_CONFIG.stands_s)

    @cached_property
    def moving(self) -> Bools:
        """Cells of obstacles that appeared in free space within the last moment."""
        return self._newer(GRID_CONFIG.moves_s)

    def _newer(self, time_s: float) -> Bools:
        """Return the cells occupied for less than a time, without edges of older obstacles."""
        edge_m = GRID_CONFIG.ground_m + GRID_CONFIG.ground_slope * self.reach_m
        edge = math.ceil(edge_m / self.cell_m)
        return self._grid.stood_less(time_s) & ~binary_dilation(
            self._grid.stood(time_s), iterations=edge
        )

    def is_new(self, turn_rad: float) -> bool:
        """Return whether the nearest obstacle in a direction, to the left of ahead, is new."""
        ahead, left = self.in_robot_axes(0.0)
        along = ahead * math.cos(turn_rad) + left * math.sin(turn_rad)
        aside = left * math.cos(turn_rad) - ahead * math.sin(turn_rad)
        # As wide as a cell, and seen from a camera that is not in the middle.
        there = self.occupied & (along > 0.0) & (np.abs(aside) < self.radius_m / 2.0)
        if not there.any():
            return False
        face = there & (along < along[there].min() + self.radius_m)
        return bool(self.new[face].mean() > 0.5)

    @property
    def moving_rad(self) -> float:
        """Direction to the nearest moving obstacle, to the left of ahead; 0 without any."""
        if not self.moving.any():
            return 0.0
        ahead, left = self.in_robot_axes(0.0)
        nearest = np.where(self.moving, self.away_m, math.inf).argmin()
        return math.atan2(left.flat[nearest], ahead.flat[nearest])

    @property
    def crowded(self) -> bool:
        """Whether a new obstacle, ahead or to a side, is too near."""
        return self._room_m(self.new, self.in_robot_axes(0.0)[0]) < 0.0

    def _room_m(self, people: Bools, ahead: Floats) -> float:
        """Return the free distance to people, ahead or to a side."""
        near_m = self.away_m[people & (ahead > 0.0)].min(initial=math.inf)
        return float(near_m) - self.body_m - GRID_CONFIG.walks_m

    def things(self, most: int) -> Floats:
        """Return the places of obstacles, at most `most` of them: (n, 2) metres ahead and left."""
        places = np.stack(self.in_robot_axes(0.0), axis=-1)[self.occupied]
        return places[:: -(-len(places) // most) or 1]

    @cached_property
    def clearance_m(self) -> Floats:
        """Distance of each cell's middle to the middle of the nearest occupied cell."""
        if not self.occupied.any():
            return np.full(self.occupied.shape, self.reach_m)
        return np.asarray(distance_transform_edt(~self.occupied)) * self.cell_m

    @property
    def _wide_m(self) -> float:
        """Minimum distance of the robot's middle to obstacles; the current distance is allowed."""
        return min(self.body_m, float(self.away_m[self.occupied].min(initial=math.inf)))

    def clear_m(self, turns_rad: Floats) -> Floats:
        """Return the free distance (k,) straight on after turns (k,) to the left."""
        ahead, left = (side[self.occupied] for side in self.in_robot_axes(0.0))
        cos = np.cos(turns_rad)[:, None]
        sin = np.sin(turns_rad)[:, None]
        along = cos * ahead + sin * left
        aside = np.abs(cos * left - sin * ahead)
        wide_m = self._wide_m
        touches_m = along - np.sqrt(np.maximum(wide_m**2 - aside**2, 0.0))
        touches_m[(aside >= wide_m - 1e-6) | (along <= 0.0)] = math.inf
        free_m = touches_m.min(axis=1, initial=self.reach_m)
        return np.asarray(np.maximum(free_m - self.cell_m, 0.0))

    def free_m(self, ahead: bool, bend: float = 0.0) -> float:
        """Return the distance that the robot can drive ahead, or back, through free cells only.

        Without a depth camera unknown cells ahead count as free; those behind never do.
        It drives in a circle of radius 1 / `bend` (1 / m) with its middle to the left, if positive.
        Moving obstacles, ahead or to a side, can come nearer until the robot stands.
        """
        along, left = self.in_robot_axes(0.0)
        along = along if ahead else -along
        room_m = self._room_m(self.moving, along)
        bend = math.copysign(max(abs(bend), _STRAIGHT), bend)
        circle_m = 1.0 / abs(bend)
        # The robot touches a cell when it has turned, about the circle's middle, until the cell is
        # as near as the robot is wide.
        out_m = circle_m - math.copysign(1.0, bend) * left
        from_middle_m = np.maximum(np.hypot(along, out_m), 1e-9)
        turned_m = circle_m * np.arctan2(along, out_m)
        wide_m = self._wide_m - 1e-6
        gap_m = from_middle_m - circle_m
        half = (wide_m**2 - gap_m**2) / (4.0 * circle_m * from_middle_m)
        touches = self.occupied & (np.abs(gap_m) < wide_m) & (along > 0.0)
        touches_m = turned_m[touches] - 2.0 * circle_m * np.arcsin(
            np.sqrt(half[touches].clip(0.0, 1.0))
        )
        unseen = self.unknown & (np.abs(gap_m) < self.radius_m - self.cell_m)
        ahead_unseen = (along > 0.0) & ~self._beside_view & self.has_camera
        unseen &= ahead_unseen if ahead else along > self.radius_m
        unseen_m = turned_m[unseen] - self.radius_m
        free_m = np.concatenate([touches_m, unseen_m, [room_m]]).min(initial=self.reach_m)
        return max(0.0, float(free_m) - self.cell_m)


#: Least bend of a way, 1 / m: within 5 m it is a millimetre off a straight way.
_STRAIGHT: Final = 1e-4


def most_speed(free_m: float, speed_m_s: float, braking_s: float, wait_s: float) -> float:
    """Return the share of the speed, 0 to 1, at which the robot can stop within a free distance.

    The robot drives on for `wait_s`, then brakes evenly; `braking_s` is the braking time from full
    speed.
    """
    # share * speed * wait + share^2 * speed * braking / 2 = free
    free_m = max(free_m, 0.0)
    waits = speed_m_s * wait_s
    brakes = speed_m_s * braking_s / 2.0
    return min(2.0 * free_m / (waits + math.sqrt(waits**2 + 4.0 * brakes * free_m)), 1.0)
