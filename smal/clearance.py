"""What a depth camera says of the ground about the robot: free, occupied or unknown, and how fast it may go there.

Each look becomes a scan: along every bearing, how far the ground is free and how near the first thing stands. Ground is
what lies on the plane below the camera, whose height is known and whose pitch and roll each look tells. Scans add up in
a grid that goes with the robot (Moravec and Elfes 1985), by its wheels, so that what has left the view is still known.
Nothing is free because nothing was seen: a look without depth leaves everything as it was, and unknown is not free.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter1d

Floats = NDArray[np.float64]

#: Rows and columns of depth that are looked at: half a degree apart, which is 4 cm at 5 m.
_ROWS, _COLUMNS = 120, 160
#: Height over the plane from which something is no ground, metres, and what is added a metre ahead: what is left of
#: noise and of a floor that is not quite even. A wheel climbs less.
_GROUND_M, _GROUND_SLOPE = 0.05, 0.02
#: Pitch and roll of a camera that shakes, and of a kerb under a wheel.
_MOST_TILT: Final = math.tan(math.radians(5.0))
#: Pixels that must show a thing at one bearing: fewer are noise.
_LEAST_PIXELS: Final = 3
#: Rows over which ground may show nothing and goes on all the same: specks without texture.
_GAP_ROWS: Final = 5
#: Share of the lower half of a picture that must have depth for it to say anything.
_LEAST_VALID: Final = 0.1
#: Of a cell: what a hit adds and what being seen through takes, and from where on it is occupied; bounds, so that what
#: has walked away is forgotten within half a second.
_HIT, _THROUGH, _OCCUPIED, _MOST, _LEAST = 2, 1, 2, 6, -3
#: Cells a robot's radius, and how far the grid reaches, in radii: some 6 m for a robot of 0.4 m.
_CELLS, _REACH = 5, 16
#: Nearer than this many radii nothing that is unknown is taken to be occupied: no camera sees its own robot's feet.
_NEAR: Final = 2.5
#: What stays between the robot and what it stops before, in radii.
_MARGIN: Final = 0.25
#: Slower than this share of its speed a robot stands.
_SLOWEST: Final = 0.05


@dataclass(frozen=True)
class Mount:
    """How a level depth camera sits on a round robot.

    Parameters
    ----------
    focal : float
        Focal length over the image's width; its axis meets the middle.
    height_m, ahead_m : float
        Of the camera, above the ground and ahead of the middle of the robot.
    radius_m, top_m : float
        Of the robot, and the height of its highest point.
    """

    focal: float
    height_m: float
    ahead_m: float
    radius_m: float
    top_m: float


class Scan(NamedTuple):
    """What one look says, along each bearing."""

    bearings: Floats
    """(n,) from the heading to the left, radians, ascending; as seen from the camera."""
    free_m: Floats
    """(n,) how far the ground is free."""
    hit_m: Floats
    """(n,) how near something stands; infinity where nothing does."""
    top_m: Floats
    """(n,) how high that is seen to be."""
    over_m: tuple[float, float]
    """Height of the lowest rays at the camera, and how much they fall a metre: nearer things may lie below."""


def scan(depth_m: NDArray[np.float32], mount: Mount) -> Scan | None:
    """Return what a depth image (h, w) says, 0 where it has none; None where that is too little to say anything."""
    height, width = depth_m.shape
    down_px, across_px = (max(1, math.ceil(size / most)) for size, most in ((height, _ROWS), (width, _COLUMNS)))
    ahead = np.asarray(depth_m[down_px // 2 :: down_px, across_px // 2 :: across_px], dtype=np.float64)[:, ::-1]
    valid = np.isfinite(ahead) & (ahead > 0.0)
    rows, columns = ahead.shape
    if valid[rows // 2 :].mean() < _LEAST_VALID:
        return None
    focal_px = mount.focal * width
    # Columns from the right to the left, so that bearings ascend.
    across = ((np.arange(columns) * across_px + across_px // 2 + 0.5) - width / 2)[::-1] / -focal_px
    below = ((np.arange(rows) * down_px + down_px // 2 + 0.5) - height / 2)[:, None] / focal_px
    ahead = np.where(valid, ahead, 0.0)
    left, up = ahead * across, mount.height_m - ahead * below
    pitch, roll = _tilt(ahead, left, up, valid)
    up -= pitch * ahead + roll * left
    away, high = np.hypot(ahead, left), _GROUND_M + _GROUND_SLOPE * ahead
    ground = valid & (np.abs(up) <= high)
    # What hangs a little higher than the robot may hang lower beside what is seen of it.
    thing = valid & (up > high) & (up < mount.top_m + mount.radius_m)
    hit_m = _nearest(np.where(thing, away, np.inf))
    beside = thing & (away < hit_m + 2.0 * mount.radius_m)
    top_m = np.where(beside, up, 0.0).max(axis=0)
    # From below on as long as the ground goes on: what shows nothing may stand there.
    goes_on = maximum_filter1d(ground.astype(np.uint8), _GAP_ROWS, axis=0)[::-1].astype(bool)
    until = np.where(goes_on.all(axis=0), rows, goes_on.argmin(axis=0))
    reached = ground[::-1] & (np.arange(rows)[:, None] < until)
    free_m = np.minimum(np.where(reached, away[::-1], 0.0).max(axis=0), hit_m)
    slope = float(below[-1, 0]) + pitch
    return Scan(np.arctan(across), free_m, hit_m, top_m, (mount.height_m, slope))


def _tilt(ahead: Floats, left: Floats, up: Floats, valid: NDArray[np.bool_]) -> tuple[float, float]:
    """Return how much the ground rises a metre ahead and to the left, as it seems to a camera that is not level."""
    pitch = roll = 0.0
    for slope in (_MOST_TILT, _MOST_TILT / 3.0):
        flat = valid & (np.abs(up - pitch * ahead - roll * left) < _GROUND_M / 2.0 + slope * ahead)
        if flat.sum() < valid.size // 50:
            return pitch, roll
        # Far points err by more: each counts by how many of its metres it is off.
        x, y, z = ahead[flat], left[flat], up[flat]
        share = y / x
        ((pitch, roll), *_) = np.linalg.lstsq(
            np.array([[x.size, share.sum()], [share.sum(), (share * share).sum() + 1e-9]]),
            np.array([(z / x).sum(), (share * z / x).sum()]),
            rcond=None,
        )
        pitch, roll = (float(np.clip(one, -_MOST_TILT, _MOST_TILT)) for one in (pitch, roll))
    return pitch, roll


def _nearest(away: Floats) -> Floats:
    """Return of each column the distance that some pixels of it and its neighbours are nearer than."""
    padded = np.pad(away, ((0, 0), (1, 1)), constant_values=np.inf)
    three = np.concatenate([padded[:, :-2], padded[:, 1:-1], padded[:, 2:]])
    return np.asarray(np.partition(three, _LEAST_PIXELS - 1, axis=0)[_LEAST_PIXELS - 1])


class Surroundings:
    """A grid about a round robot that goes with it; knows in which cells something stands, and which are free.

    Its axes are those of the odometry. Cells are (x, y); the robot is in the middle one.
    """

    def __init__(self, radius_m: float) -> None:
        self.radius_m = radius_m
        self.cell_m = radius_m / _CELLS
        self.reach_m = _REACH * radius_m
        half = _CELLS * _REACH
        self._side = 2 * half + 1
        offsets = (np.arange(self._side) - half) * self.cell_m
        #: Of each cell's middle, from that of the robot's cell, in the axes of the odometry.
        self.x_m: Floats
        self.y_m: Floats
        self.x_m, self.y_m = np.meshgrid(offsets, offsets, indexing="ij")
        self._evidence = np.zeros((self._side, self._side), dtype=np.int8)
        self._top_m = np.zeros((self._side, self._side), dtype=np.float32)
        self._cell: tuple[int, int] | None = None
        self.heading = 0.0

    def move(self, pose: Sequence[float]) -> None:
        """Go to where the wheels say that the robot is: x, y and heading in radians."""
        x, y, self.heading = pose
        cell = round(x / self.cell_m), round(y / self.cell_m)
        if self._cell is not None and cell != self._cell:
            shift = self._cell[0] - cell[0], self._cell[1] - cell[1]
            for grid in (self._evidence, self._top_m):
                grid[:] = _shifted(grid, shift)
        self._cell = cell
        self._rest = x - cell[0] * self.cell_m, y - cell[1] * self.cell_m
        under = np.hypot(self.x_m - self._rest[0], self.y_m - self._rest[1]) < self.radius_m - self.cell_m
        np.minimum(self._evidence, -1, out=self._evidence, where=under)
        self.__dict__.pop("clearance_m", None)

    def look(self, pose: Sequence[float], depth_m: NDArray[np.float32] | None, mount: Mount) -> bool:
        """Go where the wheels say, and add what a depth image shows; return whether it shows anything."""
        self.move(pose)
        seen = None if depth_m is None else scan(depth_m, mount)
        if seen is not None:
            self.see(seen, mount.ahead_m)
        return seen is not None

    def see(self, seen: Scan, ahead_m: float) -> None:
        """Add a scan from a place ahead of the robot's middle, where it is now."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x0, y0 = self._rest[0] + ahead_m * cos, self._rest[1] + ahead_m * sin
        dx, dy = self.x_m - x0, self.y_m - y0
        away, bearing = np.hypot(dx, dy), np.arctan2(dy * cos - dx * sin, dx * cos + dy * sin)
        middles = (seen.bearings[1:] + seen.bearings[:-1]) / 2.0
        ray = np.searchsorted(middles, bearing)
        apart = seen.bearings[1] - seen.bearings[0]
        through = (away < seen.free_m[ray] - self.cell_m / 2.0) & (np.abs(bearing - seen.bearings[ray]) < 2.0 * apart)
        lowest = np.maximum(seen.over_m[0] - away * seen.over_m[1], 0.0)
        evidence = self._evidence
        # What lies below the rays is not seen through; where nothing is known they say at least that nothing rises.
        cleared = through & ((lowest <= _GROUND_M) | (self._top_m > lowest))
        evidence[cleared] = np.maximum(evidence[cleared] - _THROUGH, _LEAST)
        evidence[through & (evidence == 0)] = -1
        near = np.flatnonzero(seen.hit_m < self.reach_m - 2.0 * self.cell_m)
        turned = seen.bearings[near] + self.heading
        half = self._side // 2
        hit_x = np.rint((x0 + seen.hit_m[near] * np.cos(turned)) / self.cell_m).astype(int) + half
        hit_y = np.rint((y0 + seen.hit_m[near] * np.sin(turned)) / self.cell_m).astype(int) + half
        inside = (hit_x >= 0) & (hit_x < self._side) & (hit_y >= 0) & (hit_y < self._side)
        cells = hit_x[inside], hit_y[inside]
        # Through and hit in one look: at its edges a thing is both.
        evidence[cells] = np.minimum(np.maximum(evidence[cells], 0) + _HIT, _MOST)
        np.maximum.at(self._top_m, cells, seen.top_m[near][inside].astype(np.float32))
        self._top_m[evidence < _OCCUPIED] = 0.0
        self.__dict__.pop("clearance_m", None)

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Cells in which something stands."""
        return self._evidence >= _OCCUPIED

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Cells that are neither occupied nor seen to be free."""
        return (self._evidence >= 0) & (self._evidence < _OCCUPIED)

    @cached_property
    def clearance_m(self) -> NDArray[np.float32]:
        """How far each cell's middle is from what stands nearest to it."""
        if not self.occupied.any():
            return np.full(self.occupied.shape, self.reach_m, dtype=np.float32)
        distance = np.asarray(distance_transform_edt(~self.occupied), dtype=np.float32)
        return distance * np.float32(self.cell_m) - np.float32(self.cell_m / 2.0)

    def cells(self, places: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the cells of places (..., 2) ahead of and left of the robot; those outside as the nearest inside."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        ahead, left = places[..., 0], places[..., 1]
        x, y = self._rest[0] + cos * ahead - sin * left, self._rest[1] + sin * ahead + cos * left
        half = self._side // 2
        return tuple(  # type: ignore[return-value]
            np.clip(np.rint(one / self.cell_m).astype(np.intp) + half, 0, self._side - 1) for one in (x, y)
        )

    def free_m(self, ahead: bool) -> float:
        """Return how far the robot may go straight ahead, or back, before it touches anything that is not free."""
        cos, sin = (math.cos(self.heading), math.sin(self.heading)) if ahead else (
            -math.cos(self.heading), -math.sin(self.heading)
        )  # fmt: skip
        dx, dy = self.x_m - self._rest[0], self.y_m - self._rest[1]
        along, aside = dx * cos + dy * sin, np.abs(dy * cos - dx * sin)
        occupied = self.occupied
        # What already is nearer than that may stay beside it, and come no nearer.
        nearest_m = float(np.hypot(dx, dy)[occupied].min(initial=math.inf))
        wide_m = min(self.radius_m + self.cell_m / 2.0, nearest_m)
        in_the_way = occupied & (aside < wide_m - 1e-6) & (along > 0.0)
        hits = along[in_the_way] - np.sqrt(np.maximum(wide_m**2 - aside[in_the_way] ** 2, 0.0))
        unseen = self.unknown & (aside < self.radius_m - self.cell_m / 2.0) & (along > _NEAR * self.radius_m)
        ends = along[unseen] - self.radius_m
        return float(max(0.0, min(hits.min(initial=self.reach_m), ends.min(initial=self.reach_m))))


def _shifted(grid: NDArray[np.generic], shift: tuple[int, int]) -> NDArray[np.generic]:
    """Return a grid moved by whole cells; what comes in is 0."""
    moved = np.zeros_like(grid)
    side = len(grid)
    if max(map(abs, shift)) < side:
        (to_x, from_x), (to_y, from_y) = (
            (slice(max(by, 0), side + min(by, 0)), slice(max(-by, 0), side + min(-by, 0))) for by in shift
        )
        moved[to_x, to_y] = grid[from_x, from_y]
    return moved


def most_speed(free_m: float, radius_m: float, speed_m_s: float, braking_s: float, wait_s: float) -> float:
    """Return the share, 0 to 1, of its speed at which a robot still stands before what is so far away.

    It goes on for a time before it begins to brake, which takes `braking_s` from its full speed, evenly.
    """
    room_m = free_m - _MARGIN * radius_m
    if room_m <= 0.0:
        return 0.0
    # share * speed * wait + share^2 * speed * braking / 2 = room
    waits, brakes = speed_m_s * wait_s, speed_m_s * braking_s / 2.0
    share = 2.0 * room_m / (waits + math.sqrt(waits**2 + 4.0 * brakes * room_m))
    return min(share, 1.0) if share >= _SLOWEST else 0.0
