"""Occupancy grid around the robot from a depth camera: free, occupied or unknown cells, and the safe speed.

Each image becomes a scan: for every column, the free ground and the distance of the nearest obstacle. Ground is the
plane below the camera. The mount gives its height, and each image its pitch and roll. Scans accumulate in a grid that
moves with the robot by its odometry (Moravec and Elfes 1985), so that areas out of view stay known. Obstacles that
appear in free space count as moving until they have stood for a while, and are soon forgotten out of view. Only
observed space is free: an image without depth changes nothing, and unknown cells are not free.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, shift

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GridConfig:
    """Parameters of the grid and of the way around obstacles; lengths are in radii of the robot."""

    #: Columns of a depth image in use: half a degree apart, which is 4 cm at 5 m.
    depth_columns: int = 160
    #: Minimum height of an obstacle above the plane of the ground, metres, and its increase a metre ahead, for noise
    #: and uneven floors. A wheel climbs less.
    ground_m: float = 0.05
    ground_slope: float = 0.02
    #: Maximum pitch and roll of a camera that shakes, or of a kerb under a wheel.
    tilt_deg: float = 5.0
    #: Minimum pixels of an obstacle in a column: fewer are noise.
    least_pixels: int = 3
    #: Maximum rows without ground within the free part of a column: specks without texture.
    gap_rows: int = 5
    #: Minimum share of columns with ground, or an obstacle before it.
    least_shown: float = 0.5
    #: Evidence of a hit, and bounds of the evidence of a cell: above 0 it is occupied, below 0 it is free. A ray
    #: through the cell subtracts 1, so that a person who has left is forgotten within half a second.
    hit: int = 2
    most_evidence: int = 5
    least_evidence: int = -3
    #: What has come where it was free moves until it was seen there in so many looks, half a second; not within so many
    #: cells of what stands, since distances err by one, and edges with them. Out of view it is known for so many times
    #: as long as it was seen there; for ever, once that was for so many looks, 3 s.
    still: float = 5.0
    edge: int = 3
    lasts: float = 4.0
    stays: float = 30.0
    # Kept off what moves, metres: a person's 1.6 m/s (ISO 13855) for half a second.
    walks_m: float = 0.8
    # Who has come, and stands, is kept off so much further than things, metres.
    sways_m: float = 0.1
    #: Assumed depth of an obstacle behind its visible face.
    deep: float = 2.0
    #: Cells a radius.
    cells_radius: int = 4
    #: Reach of the grid: about 5 m for a robot of 0.4 m.
    grid: int = 12
    #: Distance between a stopped robot and the obstacle.
    margin: float = 0.25
    #: Share of the speed below which a robot stands.
    slowest: float = 0.05
    #: Maximum distance from the taught way: 2.4 m for a robot of 0.4 m, where the filter still localises.
    may_go_aside: float = 6.0
    #: Clearance beyond which more has no benefit, and the extra cost of a metre without clearance.
    room: float = 2.0
    tight_cost: float = 2.0
    #: Distance at which the robot waits before an obstacle without a way round; nearer, it hides the taught views.
    stands_before: float = 6.0
    #: Candidate turns to each side: a degree apart.
    most_turns: int = 180
    #: Extra cost of a metre a correlation length beside the way, and over unknown ground.
    aside_cost: float = 1.5
    unknown_cost: float = 0.5


GRID_CONFIG: Final = GridConfig()


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

    #: (n,) offset of the column to the left, a metre ahead; evenly spaced, from the left to the right.
    across: Floats
    #: (n,) distance of free ground.
    free_m: Floats
    #: (n,) distance of the nearest obstacle; infinite without any.
    hit_m: Floats
    #: (n,) visible height of the obstacle.
    top_m: Floats
    #: Fall of the lowest rays a metre: nearer objects can be below them.
    falls: float


def above_ground(
    up_m: Floats, ahead_m: Floats, config: GridConfig = GRID_CONFIG
) -> NDArray[np.bool_]:
    """Return which points are above the ground, by their height over its plane and their distance, metres."""
    return up_m > config.ground_m + config.ground_slope * ahead_m


def scan(
    depth_m: NDArray[np.float32], mount: Mount, config: GridConfig = GRID_CONFIG
) -> Scan | None:
    """Return the scan of a depth image (h, w) in metres (0 = missing); None if the ground is not visible.

    The mount gives the distance of the ground in the lowest rows of every column. A column shows that ground, or an
    obstacle before it. If most columns show neither, the camera is blind, differs from its mount, or is at an edge.
    """
    every = max(1, math.ceil(depth_m.shape[1] / config.depth_columns))
    ahead = np.asarray(depth_m[every // 2 :: every, every // 2 :: every], dtype=np.float64)
    if ahead.shape[0] < max(config.least_pixels, config.gap_rows + 1) or ahead.shape[1] < 2:
        return None  # Too few rows to distinguish ground from obstacles.
    valid = np.isfinite(ahead) & (ahead > 0.0)
    below, across = (
        (np.arange(count) * every + every // 2 + 0.5 - size / 2) / (mount.focal * depth_m.shape[1])
        for count, size in zip(ahead.shape, depth_m.shape, strict=True)
    )
    ahead = np.where(valid, ahead, 0.0)
    left = -ahead * across
    up = mount.height_m - ahead * below[:, None]
    pitch, roll = _tilt(ahead, -across, up, valid, config)
    up -= pitch * ahead + roll * left
    ground = valid & ~above_ground(np.abs(up), ahead, config)
    # What hangs a little higher than the robot may hang lower beside what is seen of it.
    thing = valid & above_ground(up, ahead, config) & (up < mount.top_m + mount.radius_m)
    hit_m = np.partition(np.where(thing, ahead, np.inf), config.least_pixels - 1, axis=0)[
        config.least_pixels - 1
    ]
    top_m = np.where(thing & (ahead < hit_m + 2.0 * mount.radius_m), up, 0.0).max(axis=0)
    # From below on as long as the ground goes on: what shows nothing may stand there.
    goes_on = np.cumsum(~ground[::-1], axis=0)[::-1] <= config.gap_rows
    free_m = np.minimum(np.where(ground & goes_on, ahead, 0.0).max(axis=0), hit_m)
    # What stands nearer than the ground in the lowest rows hides all of it: up to there the rays met nothing. It has a
    # face, which does not recede from row to row as ground does, at whatever height that lies.
    upper = -1 - config.gap_rows
    recedes = below[-1] / below[-1 - config.gap_rows]
    hides = hit_m * (float(below[upper]) + pitch) <= mount.height_m
    hides &= valid[-1] & valid[upper] & (ahead[upper] < ahead[-1] * (1.0 + recedes) / 2.0)
    free_m = np.where(hides, hit_m, free_m)
    if np.mean(free_m > 0.0) < config.least_shown:
        return None
    return Scan(-across, free_m, hit_m, top_m, float(below[-1]) + pitch)


def _tilt(
    ahead: Floats, across: Floats, up: Floats, valid: NDArray[np.bool_], config: GridConfig
) -> Floats:
    """Return the slope of the ground ahead and to the left, as seen by a camera that is not level."""
    tilt = np.zeros(2)
    most_tilt = math.tan(math.radians(config.tilt_deg))
    sides = np.broadcast_to(across, ahead.shape)
    for slope in (most_tilt, most_tilt / 3.0):
        flat = valid & (
            np.abs(up - (tilt[0] + tilt[1] * across) * ahead)
            < config.ground_m / 2.0 + slope * ahead
        )
        if flat.sum() < valid.size // 50:
            break
        # Far points err by more: each counts by how many of its metres it is off.
        a_metre = np.stack([np.ones(int(flat.sum())), sides[flat]])
        tilt = np.linalg.lstsq(a_metre @ a_metre.T, a_metre @ (up[flat] / ahead[flat]), rcond=None)[
            0
        ]
        tilt = tilt.clip(-most_tilt, most_tilt)
    return tilt


class Surroundings:
    """Occupancy grid that moves with a round robot.

    Its axes are the axes of the odometry. Cells are (x, y); the robot is in the middle cell.
    """

    def __init__(self, radius_m: float, config: GridConfig = GRID_CONFIG) -> None:
        self.config = config
        self.radius_m = radius_m
        self.cell_m = radius_m / self.config.cells_radius
        self.reach_m = self.config.grid * radius_m
        #: How near it may come to the middle of a cell in which something stands: half a cell is that cell's, the other
        #: half is for wheels that slip.
        self.body_m = radius_m + self.cell_m
        self._half = self.config.cells_radius * self.config.grid
        offsets = np.arange(-self._half, self._half + 1) * self.cell_m
        #: Offset of each cell's middle from the middle of the robot's cell, in the axes of the odometry.
        self._x_m, self._y_m = np.meshgrid(offsets, offsets, indexing="ij")
        self._evidence = np.zeros(self._x_m.shape, dtype=np.int8)
        self._top_m = np.zeros(self._x_m.shape, dtype=np.float32)
        self._lasts = np.zeros(
            self._x_m.shape, dtype=np.float32
        )  # For how many looks what stands there is known.
        self._freed = np.zeros(
            self._x_m.shape, dtype=np.bool_
        )  # Whether it was seen, twice, to be free.
        self._cell: tuple[int, int] | None = None
        self._rest = 0.0, 0.0
        self._mount: Mount | None = None  # Mount at the last look.
        self.heading = 0.0
        self.seen: Scan | None = None  # What the last look says.

    def snapshot(self) -> Self:
        """Return an independent copy for another thread."""
        made = copy.copy(self)
        made.__dict__ |= {
            name: one.copy() for name, one in self.__dict__.items() if isinstance(one, np.ndarray)
        }
        return made

    def move(self, pose: Sequence[float]) -> None:
        """Move to the odometry pose: x, y and heading in radians."""
        x, y, self.heading = pose
        cell = round(x / self.cell_m), round(y / self.cell_m)
        if self._cell not in (None, cell):
            by = self._cell[0] - cell[0], self._cell[1] - cell[1]
            grids = (self._evidence, self._top_m, self._lasts, self._freed)
            self._evidence, self._top_m, self._lasts, self._freed = (
                shift(grid, by, order=0) for grid in grids
            )
        self._cell = cell
        self._rest = (x - cell[0] * self.cell_m, y - cell[1] * self.cell_m)
        ahead, left = self.seen_from(0.0)
        under = np.hypot(ahead, left) < self.radius_m - self.cell_m
        np.minimum(self._evidence, -1, out=self._evidence, where=under)
        for known in ("clearance_m", "moving", "_kinds", "_wide_m"):
            self.__dict__.pop(known, None)

    def look(
        self, pose: Sequence[float], depth_m: NDArray[np.float32] | None, mount: Mount
    ) -> bool:
        """Move to the odometry pose, and add a depth image; return whether it contains a scan."""
        self.move(pose)
        self.seen = seen = None if depth_m is None else scan(depth_m, mount, self.config)
        if seen is None:
            return False
        self._mount = mount
        ahead, left = self.seen_from(mount.ahead_m)
        across = left / np.maximum(ahead, self.cell_m)
        column = np.rint((seen.across[0] - across) / (seen.across[0] - seen.across[1]))
        inside = (ahead > 0.0) & (column >= 0) & (column < seen.across.size)
        column = np.where(inside, column, 0).astype(np.intp)
        through = inside & (ahead < seen.free_m[column] - self.cell_m / 2.0)
        lowest = mount.height_m - ahead * seen.falls
        evidence = self._evidence
        # What lies below the rays is not seen through; where nothing is known they say at least that nothing rises.
        cleared = through & ((lowest <= self.config.ground_m) | (self._top_m > lowest))
        evidence[cleared] = np.maximum(evidence[cleared] - 1, self.config.least_evidence)
        evidence[through & (evidence == 0)] = -1
        near = np.isfinite(seen.hit_m)
        hit_m = np.where(near, seen.hit_m, 0.0)
        cells = self.cells(np.stack([mount.ahead_m + hit_m, hit_m * seen.across], axis=1))
        self._freed |= evidence < -1
        # Behind its face, where nobody has looked, a thing goes on: who passes it does not see its side.
        behind_m = ahead - seen.hit_m[column]
        hidden = (
            inside
            & (behind_m > 0.0)
            & (behind_m < self.config.deep * self.radius_m)
            & (evidence == 0)
        )
        evidence[hidden] = 1
        self._top_m[hidden] = seen.top_m[column[hidden]]
        self._freed[hidden] = self._freed[cells][column[hidden]]
        cells = cells[0][near], cells[1][near]
        # Through and hit in one look: at its edges a thing is both.
        evidence[cells] = np.minimum(
            np.maximum(evidence[cells], 0) + self.config.hit, self.config.most_evidence
        )
        np.maximum.at(self._top_m, cells, seen.top_m[near].astype(np.float32))
        hit = np.zeros_like(self._freed)
        hit[cells] = True
        self._forget_what_walks(hit)
        for edge in (0, -1):  # What stands further away is not on the edge.
            evidence[edge] = evidence[:, edge] = 0
        self._top_m[evidence <= 0] = self._lasts[evidence <= 0] = 0
        return True

    def _forget_what_walks(self, seen: NDArray[np.bool_]) -> None:
        """Forget obstacles that appeared in free space and are out of view for longer than they were seen.

        Cells too near for the camera are kept.
        """
        leaves = (
            self._freed
            & (self._lasts >= 0.0)
            & (self._lasts < self.config.lasts * self.config.stays)
        )
        self._lasts += np.where(seen, self.config.lasts, np.where(leaves, -1.0, 0.0))
        self._evidence[(self._lasts < 0.0) & ~self._beside_view & self._walks] = 0

    @property
    def _beside_view(self) -> NDArray[np.bool_]:
        """Cells beside the robot that the camera cannot see: nearer than its view is as wide as the robot."""
        if self._mount is None:
            return np.zeros(self._evidence.shape, dtype=np.bool_)
        ahead, left = self.seen_from(self._mount.ahead_m)
        near = (
            np.hypot(*self.seen_from(0.0))
            < self._mount.ahead_m + 2.0 * self._mount.focal * self.radius_m
        )
        # Half a cell may lie outside.
        return near & (2.0 * self._mount.focal * (np.abs(left) + self.cell_m / 2.0) > ahead)

    @property
    def _walks(self) -> NDArray[np.bool_]:
        """Cells of obstacles that appeared in free space, except the edges of older obstacles."""
        return self._apart(self._freed & (self._lasts <= self.config.lasts * self.config.still))

    def _apart(self, new: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the occupied cells among some, except the edges of obstacles in other cells."""
        return (
            self.occupied
            & new
            & ~binary_dilation(self.occupied & ~new, iterations=self.config.edge)
        )

    def has_come(self, turn_rad: float) -> bool:
        """Return whether the nearest obstacle in a direction, to the left of ahead, appeared in free space."""
        ahead, left = self.seen_from(0.0)
        away_m = np.hypot(ahead, left)
        # As wide as a cell, and seen from a camera that is not in the middle.
        there = self.occupied & (
            np.abs(left * math.cos(turn_rad) - ahead * math.sin(turn_rad)) < self.radius_m / 2.0
        )
        there &= ahead * math.cos(turn_rad) + left * math.sin(turn_rad) > 0.0
        first = np.where(there, away_m, np.inf).argmin()
        return bool(there.any() and self._kinds[1][0].flat[first])

    def seen_from(self, ahead_m: float) -> tuple[Floats, Floats]:
        """Return the distance of each cell's middle ahead and left of a place ahead of the robot's middle."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        dx = self._x_m - self._rest[0]
        dy = self._y_m - self._rest[1]
        return dx * cos + dy * sin - ahead_m, dy * cos - dx * sin

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Cells with an obstacle."""
        return np.asarray(self._evidence > 0)

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Cells of visible, or just seen, obstacles that appeared recently."""
        return self._walks & (self._evidence > 1) & (self._lasts >= 0.0)

    @property
    def moving_rad(self) -> float:
        """Direction to the nearest moving obstacle, to the left of ahead; 0 without any."""
        ahead, left = (one[self.moving] for one in self.seen_from(0.0))
        nearest = np.hypot(ahead, left).argmin() if ahead.size else None
        return 0.0 if nearest is None else math.atan2(left[nearest], ahead[nearest])

    @property
    def crowded(self) -> bool:
        """Whether an obstacle that appeared, ahead or to a side, is nearer than the distance kept from people."""
        come = self._kinds[1][0]
        ahead, left = (one[come] for one in self.seen_from(0.0))
        return bool((np.hypot(ahead, left)[ahead > 0.0] < self.body_m + self.config.walks_m).any())

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """Cells that are neither occupied nor free."""
        return np.asarray(self._evidence == 0)

    def things(self, most: int) -> Floats:
        """Return places of obstacles, (n, 2) metres ahead of the robot and to its left; at most `most` places."""
        places = np.stack(self.seen_from(0.0), axis=-1)[self.occupied]
        return places[:: -(-len(places) // most) or 1]

    @cached_property
    def clearance_m(self) -> NDArray[np.float64]:
        """Distance of each cell's middle to the middle of the nearest occupied cell.

        Obstacles that appeared count as nearer by the sway of a person.
        """
        clear_m = np.full(self.occupied.shape, self.reach_m)
        for cells, sways_m in self._kinds:
            if cells.any():
                clear_m = np.minimum(
                    clear_m, np.asarray(distance_transform_edt(~cells)) * self.cell_m - sways_m
                )
        return clear_m

    @cached_property
    def _kinds(self) -> tuple[tuple[NDArray[np.bool_], float], ...]:
        """Cells of fixed obstacles, and of obstacles that appeared; with the sway of each kind, metres."""
        come = self._apart(self._freed)
        return (self.occupied & ~come, 0.0), (come, self.config.sways_m)

    @cached_property
    def _wide_m(self) -> NDArray[np.float64]:
        """Minimum distance of the robot's middle to the obstacle in each cell; the current distance is allowed."""
        away_m = np.hypot(*self.seen_from(0.0))
        wide_m = np.zeros(away_m.shape)
        for cells, sways_m in self._kinds:
            wide_m[cells] = min(self.body_m + sways_m, float(away_m[cells].min(initial=math.inf)))
        return wide_m

    def cells(self, places: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the cells of places (..., 2) ahead and left of the robot, clipped to the grid."""
        cos = math.cos(self.heading)
        sin = math.sin(self.heading)
        ahead = places[..., 0]
        left = places[..., 1]
        x = self._rest[0] + cos * ahead - sin * left
        y = self._rest[1] + sin * ahead + cos * left
        half = self._half
        row, column = (
            np.rint(one / self.cell_m).clip(-half, half).astype(np.intp) + half for one in (x, y)
        )
        return row, column

    def clear_m(self, turns_rad: Floats) -> Floats:
        """Return the free distance (k,) straight on after turns (k,) to the left."""
        ahead, left = (one[self.occupied] for one in self.seen_from(0.0))
        cos = np.cos(turns_rad)[:, None]
        sin = np.sin(turns_rad)[:, None]
        along = cos * ahead + sin * left
        aside = np.abs(cos * left - sin * ahead)
        wide_m = self._wide_m[self.occupied]
        touches_m = along - np.sqrt(np.maximum(wide_m**2 - aside**2, 0.0))
        touches_m[(aside >= wide_m - 1e-6) | (along <= 0.0)] = math.inf
        return np.asarray(
            np.maximum(
                touches_m.min(axis=1, initial=self.reach_m) - self.config.margin * self.radius_m,
                0.0,
            )
        )

    def free_m(self, ahead: bool, bend: float = 0.0) -> float:
        """Return the distance that the robot can drive ahead, or back, through free cells only.

        It drives straight, or in a circle of radius 1 / `bend` (1 / m) with its middle to the left, if positive.
        Moving obstacles, ahead or to a side, can come nearer until the robot stands.
        """
        along, left = self.seen_from(0.0)
        along = along if ahead else -along
        moves_m = (
            np.hypot(along, left)[self.moving & (along > 0.0)] - self.body_m - self.config.walks_m
        )
        aside = left
        circle_m = math.inf
        ratio = np.ones(())
        if bend:  # Along the circle, and how far outside of it; there a cell is touched a half chord earlier.
            circle_m = 1.0 / abs(bend)
            out = 1.0 / abs(bend) - math.copysign(1.0, bend) * left
            from_middle = np.maximum(np.hypot(along, out), 1e-9)
            along = circle_m * np.arctan2(along, out)
            aside = from_middle - circle_m
            ratio = np.sqrt(from_middle / circle_m)
        wide_m = self._wide_m
        half = np.sqrt(np.maximum(wide_m**2 - aside**2, 0.0)) / ratio
        if bend:
            half = 2.0 * circle_m * np.arcsin(np.minimum(half / (2.0 * circle_m), 1.0))
        touches = self.occupied & (np.abs(aside) < wide_m - 1e-6) & (along > 0.0)
        unseen = self.unknown & (np.abs(aside) < self.radius_m - self.cell_m)
        unseen &= (along > 0.0) & ~self._beside_view if ahead else along > self.radius_m
        touches_m = (along - half)[touches]
        unseen_m = along[unseen] - self.radius_m
        free_m = np.concatenate([touches_m, unseen_m, moves_m]).min(initial=self.reach_m)
        return max(0.0, float(free_m) - self.config.margin * self.radius_m)


def most_speed(free_m: float, speed_m_s: float, braking_s: float, wait_s: float) -> float:
    """Return the share of the speed, 0 to 1, at which the robot can stop within a free distance.

    The robot drives on for `wait_s`, then brakes evenly; `braking_s` is the braking time from full speed.
    """
    # share * speed * wait + share^2 * speed * braking / 2 = free
    waits = speed_m_s * wait_s
    brakes = speed_m_s * braking_s / 2.0
    share = 2.0 * free_m / (waits + math.sqrt(waits**2 + 4.0 * brakes * max(free_m, 0.0)))
    return min(share, 1.0) if share >= GRID_CONFIG.slowest else 0.0
