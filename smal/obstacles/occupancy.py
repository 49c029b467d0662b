"""Log-odds occupancy grid (Moravec and Elfes 1985) that distinguishes new obstacles.

An obstacle is new if its cell was free some seconds before. Free evidence holds down to the
height that the camera showed at that distance: a low obstacle that comes into view is not new.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from smal.arrays import Bools, Floats


@dataclass(frozen=True)
class GridConfig:
    """Parameters of the occupancy grid."""

    #: Columns of a depth image in use: half a degree apart, which is 4 cm at 5 m.
    depth_columns: int = 160
    #: Minimum height of an obstacle above the plane of the ground, metres, and its increase a metre
    #: ahead, for noise and uneven floors. A wheel climbs less.
    ground_m: float = 0.05
    ground_slope: float = 0.02
    #: Maximum pitch and roll of a camera that shakes, or of a kerb under a wheel.
    tilt_deg: float = 5.0
    #: Minimum pixels of an obstacle in a column: fewer are noise.
    least_pixels: int = 3
    #: Probability that an image hits an occupied cell, and that it passes through a free cell.
    p_hit: float = 0.7
    #: Maximum probability of a cell: five images through the cell disprove an obstacle.
    p_max: float = 0.97
    #: Half-life of the evidence for a new obstacle that is out of view, seconds.
    forgets_s: float = 1.0
    #: An obstacle counts as moving for this time, and as new for this time, seconds. People stand
    #: for seconds, and step back when the robot does.
    moves_s: float = 0.5
    stands_s: float = 10.0
    #: Cells a radius of the robot: errors of distance are about a cell.
    cells_radius: int = 4
    #: Reach of the grid in radii: about 5 m for a robot of 0.4 m.
    reach: int = 12
    #: Distance that the robot keeps from moving obstacles, metres: the way of a person (1.6 m/s,
    #: ISO 13855) in half a second.
    walks_m: float = 0.8


GRID_CONFIG: Final = GridConfig()
#: Log-odds of one hit, and of the maximum probability.
_HIT: Final = math.log(GRID_CONFIG.p_hit / (1.0 - GRID_CONFIG.p_hit))
_MOST: Final = math.log(GRID_CONFIG.p_max / (1.0 - GRID_CONFIG.p_max))


@dataclass(frozen=True)
class CellEvidence:
    """Evidence of one depth image for each cell (n, n).

    Attributes
    ----------
    hit, passed
        Whether the image shows an obstacle in the cell, or space behind the cell.
    top_m
        Visible top of the obstacle.
    lowest_m
        Height of the lowest ray in the cell.
    least_m
        Height from which on the image certainly shows obstacles in the cell.
    elapsed_s
        Time since the image before, seconds.
    """

    hit: Bools
    passed: Bools
    top_m: Floats
    lowest_m: Floats
    least_m: Floats
    elapsed_s: float


class Occupancy:
    """Square grid (n, n) of log-odds, 0 for unknown cells."""

    def __init__(self, side: int) -> None:
        self._log_odds = np.zeros((side, side))
        #: Time for which an obstacle was seen since the cell was free; infinite if it never was, and
        #: not a number if images over the obstacle cannot have shown it.
        self._stands_s = np.full((side, side), np.inf)
        #: Top of an occupied cell. In other cells, obstacles below this height are possible.
        self._height_m = np.full((side, side), np.inf)

    @property
    def occupied(self) -> Bools:
        """Cells with an obstacle."""
        return np.asarray(self._log_odds > 0.0)

    @property
    def unknown(self) -> Bools:
        """Cells that were never seen."""
        return np.asarray(self._log_odds == 0.0)

    def stood_less(self, time_s: float) -> Bools:
        """Return the cells of obstacles that were free, and have stood for less than a time."""
        return self.occupied & (self._stands_s < time_s)

    def stood(self, time_s: float) -> Bools:
        """Return the cells of obstacles that have stood for a time, or were never free."""
        return self.occupied & (self._stands_s >= time_s)

    def shift(self, cells: tuple[int, int]) -> None:
        """Move the content by cells; new cells are unknown."""
        self._log_odds = _shifted(self._log_odds, cells, 0.0)
        self._stands_s = _shifted(self._stands_s, cells, np.inf)
        self._height_m = _shifted(self._height_m, cells, np.inf)

    def assume(self, cells: Bools, occupied: bool, height_m: Floats | float) -> None:
        """Set cells to the evidence of one image."""
        self._log_odds[cells] = _HIT if occupied else -_HIT
        self._stands_s[cells] = np.inf if occupied else 0.0
        self._height_m[cells] = height_m

    def add(self, seen: CellEvidence, stays: Bools) -> None:
        """Add the evidence of an image; the cells ``stays`` forget no new obstacle."""
        before = self.occupied
        # An image over an obstacle does not disprove it.
        passed = seen.passed & ~seen.hit & ~(before & (self._height_m <= seen.lowest_m))
        # Images from further away cannot have shown a low obstacle.
        free = self._log_odds < 0.0
        low = seen.hit & free & (seen.top_m <= self._height_m + GRID_CONFIG.ground_m)
        self._stands_s[low] = np.nan
        new = self.stood_less(GRID_CONFIG.stands_s)
        self._forget(new & ~seen.hit & ~stays, seen.elapsed_s)
        # A hit makes every cell occupied: one image can save a person.
        hit = np.minimum(np.maximum(self._log_odds, 0.0) + _HIT, _MOST)
        miss = np.maximum(self._log_odds - _HIT, -_HIT)
        self._log_odds = np.where(seen.hit, hit, np.where(passed, miss, self._log_odds))
        self._learn_heights(seen, passed, before)
        self._stands_s = np.where(seen.hit, self._stands_s + seen.elapsed_s, self._stands_s)
        self._stands_s[self._log_odds < 0.0] = 0.0

    def _forget(self, cells: Bools, elapsed_s: float) -> None:
        self._log_odds[cells] *= 0.5 ** (elapsed_s / GRID_CONFIG.forgets_s)
        # Out of view, the obstacle can have left or can stand there: the cell is unknown, not free.
        gone = cells & (self._log_odds < _HIT / 2.0)
        self._log_odds[gone] = 0.0
        self._stands_s[gone] = np.inf
        self._height_m[gone] = np.inf

    def _learn_heights(self, seen: CellEvidence, passed: Bools, before: Bools) -> None:
        now = self.occupied
        top_m = np.where(before, self._height_m, 0.0)
        free_m = np.where(before, np.inf, self._height_m)
        top_m = np.where(seen.hit, np.maximum(top_m, seen.top_m), top_m)
        free_m = np.where(passed, np.minimum(free_m, seen.least_m), free_m)
        self._height_m = np.where(now, top_m, free_m)


def _shifted(grid: Floats, cells: tuple[int, int], new: float) -> Floats:
    side = len(grid)
    moved = np.full_like(grid, new)
    x, y = (min(max(step, -side), side) for step in cells)
    to = np.s_[max(x, 0) : side + min(x, 0), max(y, 0) : side + min(y, 0)]
    of = np.s_[max(-x, 0) : side + min(-x, 0), max(-y, 0) : side + min(-y, 0)]
    moved[to] = grid[of]
    return moved
