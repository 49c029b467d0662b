"""Evaluate a laser scan for the ways ahead and back: blocked, free or unknown."""

import math
from typing import Final, NamedTuple

import numpy as np

from services.ros2.config import ScanTopic
from services.ros2.messages import MessageError, RosMessage

# A whole turn; drivers round it, by far less than one in a hundred.
_TURN_RAD: Final = 1.01 * math.tau


class Way(NamedTuple):
    """Evaluation of one way."""

    nearest_m: float
    """Distance of the nearest obstacle within `ScanTopic.stop_m`, otherwise infinity; 0 if too near
    to measure.
    """
    unseen_rad: float  # The widest angle without a valid beam.
    seen: bool  # Whether that angle is narrow enough for the way to be free.


def ways(message: RosMessage, scan: ScanTopic) -> tuple[Way, Way]:
    """Evaluate a LaserScan for the way ahead, and the way back.

    Blocked is -inf or a range, even below the scanner's minimum; free is +inf or a valid range (REP
    117). NaN, 0 (unless `zero_is_free`), and parts of the robot are unknown.

    Raises
    ------
    MessageError
        If angles or limits are invalid, or the scanner cannot measure at `ScanTopic.stop_m`.
    """
    ranges = np.asarray(message.ranges, dtype=np.float64)
    _check(message, ranges.size, scan)
    near = (ranges == -math.inf) | ((ranges > scan.blind_m) & (ranges < scan.stop_m))
    free = (ranges >= scan.stop_m) & (ranges <= message.range_max) | (ranges == math.inf)
    if scan.zero_is_free:
        free |= ranges == 0.0
    angles = message.angle_min + message.angle_increment * np.arange(ranges.size)
    half_rad = min(scan.half_angle_rad, math.pi)

    def way(middle_rad: float) -> Way:
        off = np.remainder(angles - middle_rad + math.pi, math.tau) - math.pi
        inside = np.abs(off) <= half_rad
        valid = np.sort(off[inside & (near | free)])
        gap_rad = float(np.diff(valid, prepend=-half_rad, append=half_rad).max())
        nearest_m = float(ranges[inside & near].min(initial=math.inf))
        return Way(max(0.0, nearest_m), gap_rad, gap_rad <= min(scan.gap_rad, half_rad))

    return way(scan.ahead_rad), way(scan.ahead_rad + math.pi)


def _check(message: RosMessage, beams: int, scan: ScanTopic) -> None:
    begin = message.angle_min
    step = message.angle_increment
    end = message.angle_max
    turn = step * (beams - 1)
    geometry = beams > 0 and step != 0 and abs(begin) <= _TURN_RAD and abs(turn) <= _TURN_RAD
    if not (geometry and abs(begin + turn - end) <= scan.gap_rad):
        raise MessageError(
            f"invalid scan: {beams} beams from {begin:g} to {end:g} rad in steps of {step:g}"
        )
    if not 0 <= message.range_min < scan.stop_m <= message.range_max:
        limits = f"from {message.range_min:g} to {message.range_max:g} m"
        raise MessageError(
            f"invalid range {limits}: obstacles nearer than {scan.stop_m:g} m are not covered"
        )
