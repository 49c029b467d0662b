"""Ticks of 10 Hz out of whatever rates a source has.

A tick shows the frame that is nearest to its time. What the robot did in it is how far it went until the next one:
a velocity holds until the next, but not longer than a base would obey it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import MAX_TICK
from services.importers.drive import FASTEST_M_S, LATEST_S, Array, Drive, Frame, ImportFailure, Motion, Tally, Track
from smal.movement import seen_from

#: Time between two ticks, on which the stack runs and learning reckons.
TICK_S: Final = 0.1
#: A base stops that has not been told anything for so long: what ROS drivers usually have, and twice what our gate has.
HOLD_S: Final = 0.5
#: Further from any frame than this a tick has none: a camera slower than 4 Hz shows too little of the way.
GAP_S: Final = 0.125
#: Share of a tick that times may be off by the rounding of numbers.
_ROUNDING: Final = 1e-5
#: A recording has no pose further from its first.
_FURTHEST_M: Final = 1e6


class Tick(NamedTuple):
    """One moment of a drive and its image.

    Attributes
    ----------
    number
        From 0, ten a second; those without a frame are missing.
    frame
        Nearest to its time.
    """

    number: int
    frame: Frame


def ticks(frames: Iterator[Frame], from_s: float, to_s: float, tally: Tally) -> Iterator[Tick]:
    """Give the ticks of a drive, and count what becomes of its frames.

    Parameters
    ----------
    frames
        In the order of their times.
    from_s, to_s
        Which part of the drive, in seconds from its first frame; tick 0 is at its first frame within.
    tally
        Gets how many frames were between two ticks, stand for more than one, and how many ticks have none.
    """
    chosen = _chosen(frames, from_s, to_s, tally)
    first = next(chosen, None)
    if first is None:
        return
    start_s, number = first.time_s, 0
    for held, following in pairwise(chain((first,), chosen, (None,))):
        assert held is not None  # noqa: S101 - only the last one is
        # Nearer to this frame than to the next, and not before the ticks of the frame before.
        end_s = held.time_s + TICK_S / 2.0 if following is None else (held.time_s + following.time_s) / 2.0
        begin = max(number, math.ceil((held.time_s - GAP_S - start_s) / TICK_S - _ROUNDING))
        end = math.ceil((end_s - start_s) / TICK_S - _ROUNDING)
        end = _checked(min(end, math.floor((held.time_s + GAP_S - start_s) / TICK_S + _ROUNDING) + 1))
        if end <= begin:
            tally.count("frames between two ticks are not needed")
            continue
        tally.count("ticks have no frame", begin - number)
        tally.count("ticks show the frame of the tick before", end - begin - 1)
        yield from (Tick(each, held) for each in range(begin, end))
        number = end


def _checked(number: int) -> int:
    if number > MAX_TICK:
        raise ImportFailure(f"a drive of {number * TICK_S / 86400.0:.3g} days: its times are not in seconds")
    return number


def _chosen(frames: Iterator[Frame], from_s: float, to_s: float, tally: Tally) -> Iterator[Frame]:
    first_s = last_s = None
    for frame in frames:
        if not math.isfinite(frame.time_s) or (last_s is not None and frame.time_s <= last_s):
            tally.count("frames are not later than the one before")
            continue
        first_s = frame.time_s if first_s is None else first_s
        last_s = frame.time_s
        if abs(frame.time_s) > LATEST_S:
            raise ImportFailure("times beyond all calendars: they are not in seconds")
        if from_s <= frame.time_s - first_s <= to_s:
            yield frame


class Moves:
    """How far the robot goes, from its velocities.

    Parameters
    ----------
    motion
        Its samples hold until the next, at most `HOLD_S`.
    """

    def __init__(self, motion: Motion) -> None:
        ends = np.append(motion.times_s[1:], np.inf)
        self._knots = np.stack([motion.times_s, np.minimum(ends, motion.times_s + HOLD_S)], axis=1).ravel()
        pairs = np.stack([motion.linear, motion.angular])
        spans = np.diff(self._knots.reshape(-1, 2), axis=1)[:, 0]
        sums = np.cumsum(pairs * spans, axis=1)
        # At its sample's time a velocity has added nothing yet, at its end all of it, and in between what is usual.
        self._sums = np.stack([sums - pairs * spans, sums], axis=2).reshape(2, -1)

    def until(self, times_s: Array) -> Array:
        """Return how far it went, and turned, until each time, (2, n)."""
        if not self._knots.size:
            return np.zeros((2, times_s.size))
        return np.stack([np.interp(times_s, self._knots, sums) for sums in self._sums])

    def velocities(self, times_s: Array) -> Array:
        """Return the mean velocities, linear and angular, over the tick that begins at each time, (2, n)."""
        mean: Array = (self.until(times_s + TICK_S) - self.until(times_s)) / TICK_S
        return mean

    def silent(self, times_s: Array) -> int:
        """Count ticks within which no velocity holds: the robot is taken to stand."""
        where = np.searchsorted(self._knots, times_s, side="right")
        after = np.searchsorted(self._knots, times_s + TICK_S, side="left")
        return int(((where == after) & (where % 2 == 0)).sum())

    def way(self, times_s: Array) -> Array:
        """Add the velocities up: poses (n, 3) at times, beginning at (0, 0, 0).

        This is dead reckoning: by measured velocities as good as the wheels' own; by commanded ones it takes the robot
        to do at once what it is told.
        """
        inside = self._knots[(self._knots > times_s[0]) & (self._knots < times_s[-1])]
        grid = np.union1d(times_s, inside)
        gone, turned = self.until(grid)
        middle = (turned[1:] + turned[:-1]) / 2.0
        steps = np.stack([np.cos(middle), np.sin(middle)]) * np.diff(gone)
        places = np.concatenate([np.zeros((2, 1)), np.cumsum(steps, axis=1)], axis=1)
        poses = np.stack([*places, turned - turned[0]], axis=1)
        found: Array = poses[np.searchsorted(grid, times_s)]
        return found


def odometry(drive: Drive, times_s: Array, moves: Moves | None) -> tuple[Array, NDArray[np.bool_]] | None:
    """Give the pose at each tick, as seen from the first one.

    Parameters
    ----------
    drive
        Its track is taken where it has one.
    times_s
        Of the ticks, (n,).
    moves
        What to reckon from where it has none; None where velocities are in no known unit.

    Returns
    -------
    (poses, known) or None
        (n, 3) and (n,): a tick further than `HOLD_S` from the samples of the track has none.

    Raises
    ------
    ImportFailure
        When it jumps.
    """
    found = _way(drive, times_s, moves)
    if found is not None and float(np.abs(found[0][found[1], :2]).max()) > _FURTHEST_M:
        raise ImportFailure(f"drive {drive.name}: goes further than {_FURTHEST_M / 1000.0:.0f} km")
    return found


def _way(drive: Drive, times_s: Array, moves: Moves | None) -> tuple[Array, NDArray[np.bool_]] | None:
    if drive.track is None:
        return None if moves is None else (moves.way(times_s), np.ones(times_s.size, dtype=bool))
    poses, known = _tracked(drive.track, times_s)
    if not known.any():
        return None
    steps = np.hypot(*np.diff(poses[known, :2], axis=0).T)
    passed_s = np.diff(times_s[known])
    if steps.size and float((steps / passed_s).max()) > FASTEST_M_S:
        at = int((steps / passed_s).argmax())
        raise ImportFailure(
            f"drive {drive.name}: the odometry jumps by {steps[at]:.3g} m within {passed_s[at]:.1f} s, "
            f"{times_s[known][at] - times_s[0]:.1f} s after the first frame; cut there with --from and --to"
        )
    return seen_from(poses, np.broadcast_to(poses[known][0], poses.shape)), known


def _tracked(track: Track, times_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    heading = np.unwrap(track.poses[:, 2])
    columns = (*track.poses[:, :2].T, heading)
    poses = np.stack([np.interp(times_s, track.times_s, column) for column in columns], axis=1)
    after = np.searchsorted(track.times_s, times_s)
    before = np.clip(after - 1, 0, track.times_s.size - 1)
    after = np.clip(after, 0, track.times_s.size - 1)
    near = np.minimum(np.abs(times_s - track.times_s[before]), np.abs(times_s - track.times_s[after]))
    return poses, near <= HOLD_S
