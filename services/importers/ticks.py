"""Resampling of drives to ticks of 10 Hz, with the action of each tick.

A tick shows the frame that is nearest to its time. Its movement is the distance to the next tick: a
velocity holds until the next velocity, at most for the command timeout of a base.

The usual speed and turn rate are measured on the source itself, so that one rule works for a toy
car's throttle and for metres per second. If a tick drives and turns, it is a turn if the turn is
sharp.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import MAX_TICK, TICK_S, Velocity
from services.importers.drive import (
    LATEST_S,
    Array,
    ImportedDrive,
    ImportFailure,
    Tally,
)
from smal.movement import seen_from

#: Command timeout of a base: as in ROS drivers, twice the timeout of our gate.
HOLD_S: Final = 0.5
#: Largest distance of a tick from its frame.
GAP_S: Final = 0.125
#: The same for a slower camera, in periods of the camera: half a period, and its jitter.
_GAP: Final = 0.75
_SLOWEST_S: Final = 1.0  # Period above which too little of the route is visible.
_ROUNDING_S: Final = 1e-6  # Rounding error of times.
_FURTHEST_M: Final = 1e6  # Maximum distance of a recorded pose from the first pose.
#: Smallest intended velocities: 2 cm and 6 degrees per second. Without units they are 2 % of full
#: throttle, and 10 % of full lock at that throttle.
LEAST_LINEAR = 0.02
LEAST_ANGULAR = 0.1
#: Quantile of the moving samples that defines the nominal speed and turn rate: the fastest samples
#: are noise or slips.
QUANTILE: Final = 0.95


class Ticks(NamedTuple):
    """The ticks with a frame from `start_s` on: numbers (n,) and frames shown (n,), ascending."""

    numbers: NDArray[np.intp]
    frames: NDArray[np.intp]
    start_s: float

    @property
    def times_s(self) -> Array:
        """Time of each tick."""
        return np.asarray(self.start_s + TICK_S * self.numbers, dtype=np.float64)


def ticks(times_s: Array, from_s: float, to_s: float, tally: Tally) -> Ticks:
    """Return the ticks of a drive from the times of its frames, and count the omitted frames.

    The drive is cut to a part, in seconds from its first frame; tick 0 is at the first frame in it.
    Raises ImportFailure if times are not in seconds.
    """
    numbers = np.where(np.isfinite(times_s), times_s, -np.inf)
    before = np.maximum.accumulate(np.concatenate([[-np.inf], numbers]))[:-1]
    later = np.flatnonzero(numbers > before)
    tally.count("frames are not later than the frame before", times_s.size - later.size)
    if (np.abs(times_s[later]) > LATEST_S).any():
        raise ImportFailure("invalid times: not in seconds")
    passed_s = times_s[later] - times_s[later[:1]]
    chosen = later[(from_s <= passed_s) & (passed_s <= to_s)]
    if not chosen.size:
        return Ticks(chosen, chosen, 0.0)
    there_s = times_s[chosen]
    count = math.ceil((there_s[-1] + TICK_S / 2.0 - there_s[0] - _ROUNDING_S) / TICK_S)
    if count > MAX_TICK:
        raise ImportFailure(
            f"invalid times: a drive of {count * TICK_S / 86400.0:.3g} days; times must be in "
            "seconds"
        )
    due_s = there_s[0] + TICK_S * np.arange(count)
    nearest = np.searchsorted((there_s[1:] + there_s[:-1]) / 2.0, due_s + _ROUNDING_S, side="right")
    near = np.abs(there_s[nearest] - due_s) <= gap_of(there_s) + _ROUNDING_S
    shown = np.unique(nearest[near]).size
    tally.count("frames between two ticks are not needed", chosen.size - shown)
    tally.count("ticks have no frame", int((~near).sum()))
    tally.count("ticks show the frame of the tick before", int(near.sum()) - shown)
    return Ticks(np.flatnonzero(near), chosen[nearest[near]], float(there_s[0]))


def gap_of(times_s: Array) -> float:
    """Return the largest distance of a tick from its frame for frames at times."""
    period_s = float(np.median(np.diff(times_s))) if times_s.size > 1 else 0.0
    return max(GAP_S, _GAP * min(period_s, _SLOWEST_S))


class Moves:
    """Movement of the robot from its motion: a sample holds until the next, at most `hold_s`."""

    def __init__(self, motion: Array) -> None:
        # A base that receives commands once a second holds them for longer.
        usual_s = float(np.median(np.diff(motion[:, 0]))) if len(motion) > 1 else 0.0
        self.hold_s = max(HOLD_S, 2.0 * usual_s)
        ends_s = motion[:, 0] + self.hold_s
        silent = np.append(motion[1:, 0], np.inf) > ends_s
        # Without a next sample in time the robot stands: a separate row, marked in the last column.
        stops = np.column_stack([ends_s, np.zeros((len(motion), 2)), np.ones(len(motion))])[silent]
        rows = np.concatenate([np.column_stack([motion, np.zeros(len(motion))]), stops])
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self._times_s = rows[:, 0]
        self._stands = rows[:, 3] > 0.0
        gone = np.diff(self._times_s)[:, None] * rows[:-1, 1:3]
        self._sums = np.concatenate([np.zeros((1, 2)), np.cumsum(gone, axis=0)])

    def until(self, times_s: Array) -> Array:
        """Return the distance and the turn until each time, (n, 2)."""
        if not self._times_s.size:
            return np.zeros((times_s.size, 2))
        return np.stack([np.interp(times_s, self._times_s, sums) for sums in self._sums.T], axis=1)

    def velocities(self, times_s: Array) -> Array:
        """Return the mean velocities (linear, angular) over the tick from each time, (n, 2)."""
        mean: Array = (self.until(times_s + TICK_S) - self.until(times_s)) / TICK_S
        return mean

    def silent(self, times_s: Array) -> int:
        """Count the ticks without a velocity, which count as standing."""
        first, last = (
            np.searchsorted(self._times_s, at_s) - 1
            for at_s in (times_s + _ROUNDING_S, times_s + TICK_S)
        )
        stands = np.append(self._stands, True)
        return int((stands[first] & (first == last)).sum())

    def way(self, times_s: Array) -> Array:
        """Integrate the velocities by dead reckoning: poses (n, 3) at times, from (0, 0, 0)."""
        inside = self._times_s[(self._times_s > times_s[0]) & (self._times_s < times_s[-1])]
        grid = np.union1d(times_s, inside)
        gone, turned = (self.until(grid) - self.until(grid[:1])).T
        middle = (turned[1:] + turned[:-1]) / 2.0
        steps = np.stack([np.cos(middle), np.sin(middle)], axis=1) * np.diff(gone)[:, None]
        places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        found: Array = np.column_stack([places, turned])[np.searchsorted(grid, times_s)]
        return found


def odometry(
    drive: ImportedDrive, times_s: Array, moves: Moves | None
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return the poses at times of ticks, (n, 3), relative to the first, and their validity.

    Poses come from the drive's track and are unknown further than `HOLD_S` from its samples.
    Without a track they are computed from the motion, if any. Raises ImportFailure if the track
    leaves the plausible area.
    """
    if drive.track.size:
        poses, known = tracked(drive.track, times_s)
        if not known.any():
            return None
        poses = seen_from(poses, np.broadcast_to(poses[known][0], poses.shape))
    elif moves is not None:
        poses = moves.way(times_s)
        known = np.ones(times_s.size, dtype=bool)
    else:
        return None
    if float(np.abs(poses[known, :2]).max()) > _FURTHEST_M:
        raise ImportFailure(
            f"{drive.called}: odometry too large (more than {_FURTHEST_M / 1000.0:.0f} km)"
        )
    return poses, known


def moving(motion: Array) -> NDArray[np.bool_]:
    """Return which samples (time, speed, turn rate) move the robot."""
    speed, turn = np.abs(motion[:, 1:3]).T
    return np.asarray((speed > LEAST_LINEAR) | (turn > LEAST_ANGULAR), dtype=bool)


def motion_along(track: Array) -> Array:
    """Return time, speed ahead and turn rate along poses (time, x, y, heading), each over a tick."""
    times_s = track[:, 0]
    after = np.searchsorted(times_s, times_s + TICK_S - _ROUNDING_S)
    after = np.minimum(after, times_s.size - 1)
    passed_s = times_s[after] - times_s
    before = np.flatnonzero((passed_s > 0.0) & (passed_s <= HOLD_S))
    after = after[before]
    steps = seen_from(track[after, 1:], track[before, 1:])
    rates = steps[:, [0, 2]] / passed_s[before, None]
    return np.column_stack([times_s[before], rates])


def tracked(track: Array, times_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the poses of a track at times, (n, 3), and whether samples are beside."""
    columns = (track[:, 1], track[:, 2], np.unwrap(track[:, 3]))
    poses = np.stack([np.interp(times_s, track[:, 0], column) for column in columns], axis=1)
    after = np.searchsorted(track[:, 0], times_s)
    beside = np.clip([after - 1, after], 0, len(track) - 1)
    return poses, np.abs(track[beside, 0] - times_s).min(axis=0) <= HOLD_S


class Nominal(NamedTuple):
    """The usual speed and turn rate of the robot, in units of the source."""

    linear: float
    angular: float


def nominal(velocities: Array, quantile: float = QUANTILE) -> Nominal:
    """Measure the speeds on the samples of all drives, (n, 2); raise ImportFailure without movement."""
    linear, angular = np.abs(velocities).T
    driving = linear[linear > LEAST_LINEAR]
    turning = angular[angular > LEAST_ANGULAR]
    if not driving.size:
        raise ImportFailure(
            "the robot never drives: all velocities are below 0.02; check that they are in "
            "metres per second"
        )
    fast = float(np.quantile(turning, quantile)) if turning.size else LEAST_ANGULAR
    return Nominal(float(np.quantile(driving, quantile)), fast)


def shares_of(velocities: Array, usual: Nominal) -> list[Velocity]:
    """Return velocities (n, 2) as fractions of the nominal velocities."""
    return [Velocity(*share) for share in np.clip(velocities / usual, -1.0, 1.0).round(6).tolist()]
