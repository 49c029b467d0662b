"""Which boxes lie wholly behind buildings, seen from a point: a horizon of the tops of walls; knows nothing of SAPIEN.

The view is cut into upright sectors. For a row of distances each sector holds the steepest slope below which buildings
nearer than that hide all that is further. All roundings err towards drawing: what is called hidden shows in no pixel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from services.simulator.scene.surfaces import Block

_SECTOR: Final = math.radians(0.5)
# The distances before which blocks are put together into one horizon, metres.
_REACH_M: Final = np.geomspace(8.0, 256.0, 21)
# The camera cuts off what is nearer than a tenth of a metre along its axis, and sees through it.
_CLIPPED_M: Final = 0.5
# In a wider view, or one that looks straight down, nothing is called hidden.
_WIDEST: Final = math.radians(80.0)


class View(NamedTuple):
    """Where from and where to one looks.

    Attributes
    ----------
    eye
        (3,) position, metres.
    azimuth
        Of the middle of the view, radians.
    half
        From there to either side, radians.
    """

    eye: NDArray[np.float64]
    azimuth: float
    half: float

    @property
    def sectors(self) -> int:
        """How many sectors the view has, from its right end to its left."""
        return math.ceil(2 * self.half / _SECTOR)

    def off(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the azimuth of points (..., 2) about the eye, from the middle of the view, -pi to pi."""
        return _wrapped(np.arctan2(points[..., 1], points[..., 0]) - self.azimuth)


def looking(eye: NDArray[np.float64], axes: NDArray[np.float64], tangents: tuple[float, float]) -> View:
    """Return the view of a camera.

    Parameters
    ----------
    eye
        (3,) position of the camera, metres.
    axes
        (3, 3) unit vectors ahead, to the left and up, in rows.
    tangents
        Of half the angle that the camera sees across, and upright.
    """
    ahead, left, up = axes
    azimuth = math.atan2(ahead[1], ahead[0])
    corners = np.array([ahead + x * tangents[0] * left + y * tangents[1] * up for x in (-1, 1) for y in (-1, 1)])
    half = float(np.abs(View(eye, azimuth, 0.0).off(corners[:, :2])).max())
    return View(eye, azimuth, half + _SECTOR)


class _Walls(NamedTuple):
    """Walls that face the eye, in azimuths from the right end of the view.

    Attributes
    ----------
    block
        (m,) number of the block of each.
    begin, end
        (m, 2) about the eye, metres.
    low, high
        (m,) azimuth of the right and of the left end.
    right, left
        (m,) azimuths between which the whole block stands.
    """

    block: NDArray[np.intp]
    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    right: NDArray[np.float64]
    left: NDArray[np.float64]


class Occluders:
    """Upright blocks on the ground that hide what is behind them."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        outlines = [block.outline for block in blocks]
        self._heights_m = np.array([block.height_m for block in blocks])
        self._sides = np.array([len(outline) - 1 for outline in outlines], dtype=np.intp)
        self._first = np.cumsum(self._sides) - self._sides
        self._begin = np.concatenate([np.empty((0, 2)), *(outline[:-1] for outline in outlines)])
        self._end = np.concatenate([np.empty((0, 2)), *(outline[1:] for outline in outlines)])
        self._middle = np.array([outline.mean(axis=0) for outline in outlines]).reshape(-1, 2)
        away = [np.linalg.norm(outline - outline.mean(axis=0), axis=1).max() for outline in outlines]
        self._radius_m = np.array(away, dtype=np.float64)

    def hidden(self, view: View, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which boxes cannot be seen because blocks are before them.

        Parameters
        ----------
        view
            Where one looks; what is beside it is of no interest.
        boxes
            (n, 2, 3) lowest and highest corner of each, metres.

        Returns
        -------
        (n,) True for what is hidden; False says nothing.
        """
        found = np.zeros(len(boxes), dtype=bool)
        if view.half > _WIDEST or not len(near := self._near(view)):
            return found
        low, high = boxes[:, 0, :2] - view.eye[:2], boxes[:, 1, :2] - view.eye[:2]
        away_m = np.linalg.norm(np.maximum(0.0, np.maximum(low, -high)), axis=1)
        slope = np.maximum(0.0, boxes[:, 1, 2] - view.eye[2]) / np.maximum(away_m, _CLIPPED_M)
        reach = np.searchsorted(_REACH_M, away_m, side="right") - 1
        first, last = _spans(view, low, high)
        asked = np.flatnonzero((reach >= 0) & (first <= last))
        if len(asked):
            horizon = self._horizon(view, near)
            row = reach[asked] * view.sectors
            found[asked] = _lowest(horizon.ravel(), row + first[asked], row + last[asked]) >= slope[asked]
        return found

    def _near(self, view: View) -> NDArray[np.intp]:
        """Return the blocks that may stand in the view, near enough."""
        to = self._middle - view.eye[:2]
        away_m = np.linalg.norm(to, axis=1)
        wide = np.arcsin(np.minimum(1.0, self._radius_m / np.maximum(away_m, _CLIPPED_M)))
        in_view = np.abs(view.off(to)) - wide < view.half
        return np.flatnonzero(in_view & (away_m - self._radius_m < _REACH_M[-1]))

    def _horizon(self, view: View, near: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the rise over run below which blocks hide all that is further away, (reaches, sectors)."""
        horizon = np.full((len(_REACH_M), view.sectors), -np.inf)
        block, sector, away_m = _pieces(view, self._facing(view, near))
        # A ray enters a block through one of the walls that face the eye: not later than through the furthest of them.
        key = block * view.sectors + sector
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        if len(starts):
            away_m, one = np.maximum.reduceat(away_m[order], starts), order[starts]
            reach = np.searchsorted(_REACH_M, away_m)
            hides = reach < len(_REACH_M)
            slope = (self._heights_m[near[block[one]]] - view.eye[2]) / away_m
            np.maximum.at(horizon, (reach[hides], sector[one][hides]), slope[hides])
        return np.asarray(np.maximum.accumulate(horizon, axis=0))

    def _facing(self, view: View, near: NDArray[np.intp]) -> _Walls:
        sides = self._sides[near]
        starts = np.cumsum(sides) - sides
        block = np.repeat(np.arange(len(near)), sides)
        every = np.arange(len(block)) + (self._first[near] - starts)[block]
        begin, end = self._begin[every] - view.eye[:2], self._end[every] - view.eye[:2]
        turn = np.arctan2(_cross(begin, end), np.einsum("ij,ij->i", begin, end))
        # Azimuths along each outline without a jump: only around an eye that the block is all around do they not close.
        so_far = np.cumsum(turn) - turn
        azimuth = so_far + (view.off(begin[starts]) - so_far[starts])[block]
        right, left = np.minimum.reduceat(azimuth, starts), np.maximum.reduceat(azimuth, starts)
        outside = np.abs(np.add.reduceat(turn, starts)) < math.pi
        # The middle of each block as near the middle of the view as whole turns allow.
        shift = _wrapped((right + left) / 2) - (right + left) / 2 + view.half
        wall = np.flatnonzero((turn < 0) & outside[block])
        which = block[wall]
        high = azimuth[wall] + shift[which]
        return _Walls(
            which, begin[wall], end[wall], high + turn[wall], high, (right + shift)[which], (left + shift)[which]
        )


def _pieces(view: View, walls: _Walls) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Cut walls into sectors.

    Returns
    -------
    block, sector
        (k,) numbers of both for each piece.
    away_m
        (k,) greatest distance of the piece; infinite where its block does not fill the sector.
    """
    first = np.maximum(np.floor(walls.low / _SECTOR).astype(np.intp), 0)
    last = np.minimum(np.floor(walls.high / _SECTOR).astype(np.intp), view.sectors - 1)
    touched = np.maximum(last - first + 1, 0)
    wall = np.repeat(np.arange(len(first)), touched)
    sector = np.arange(len(wall)) + (first - (np.cumsum(touched) - touched))[wall]
    edges = sector[:, None] * _SECTOR + (0.0, _SECTOR)
    filled = (edges[:, 0] >= walls.right[wall]) & (edges[:, 1] <= walls.left[wall])
    rays = np.clip(edges, walls.low[wall, None], walls.high[wall, None]) + (view.azimuth - view.half)
    along = (walls.end - walls.begin)[wall]
    # A ray and a line: the distance is greatest at one of the ends.
    across = np.cos(rays) * along[:, 1:] - np.sin(rays) * along[:, :1]
    away_m = _cross(walls.begin, walls.end)[wall, None] / across
    hides = filled & (away_m.min(axis=1) > _CLIPPED_M)
    return walls.block[wall], sector, np.where(hides, away_m.max(axis=1), np.inf)


def _spans(
    view: View, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last sector in view of rectangles, given their corners (n, 2) about the eye."""
    corners = np.stack(
        [low, high, np.stack([high[:, 0], low[:, 1]], axis=1), np.stack([low[:, 0], high[:, 1]], axis=1)]
    )
    middle = view.off((low + high) / 2)
    off = _wrapped(view.off(corners) - middle)
    first = np.floor((middle + off.min(axis=0) + view.half) / _SECTOR).astype(np.intp)
    last = np.floor((middle + off.max(axis=0) + view.half) / _SECTOR).astype(np.intp)
    return np.maximum(first, 0), np.minimum(last, view.sectors - 1)


def _lowest(values: NDArray[np.float64], first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the least of the values (n,) from each first to its last."""
    # Every other minimum is of what lies between; one value more, since an end may be that of the array.
    ends = np.stack([first, last + 1], axis=1).ravel()
    return np.asarray(np.minimum.reduceat(np.append(values, -np.inf), ends)[::2])


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle + math.pi) % math.tau - math.pi)
