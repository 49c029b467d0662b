"""Where the wheels say that the base is, and what that means for an episode."""

import math
from typing import NamedTuple

from services.robot.body import OdometryReading

# Poses further apart than the base can have gone, by this much, are of wheels that began to count anew.
_LEAP_M = 0.3
_LEAP_RAD = 0.3
#: As `schemas.motion` has it; and far more than any base does.
_MOST_M = 1e6
_MOST_RAD_S = 100.0
_MOST_M_S = 100.0


class Wheels(NamedTuple):
    """Where the wheels say that a base is since we listen, how far it went (backwards less), and how far it turned."""

    read_s: float  # When that was, by our clock.
    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    ahead_m: float = 0.0
    turned_rad: float = 0.0


class WheelTrack:
    """Adds up what the wheels say, so that a base whose count begins anew does not leap.

    Of the speeds that the base has at most twice is believed. After so much silence the count may have begun anew: it
    has where it is nearer to nothing than to what it was.
    """

    def __init__(self, speed_m_s: float, turn_rate_rad_s: float, silence_s: float) -> None:
        self._silence_s = silence_s
        self._speed_m_s = speed_m_s
        self._turn_rate_rad_s = turn_rate_rad_s
        self._raw: tuple[float, float, float] | None = None
        self._now = Wheels(0.0)
        self.leaps = 0  # How many times it leapt.

    def add(self, read_s: float, x_m: float, y_m: float, heading_rad: float) -> Wheels:
        """Take the next pose."""
        now = self._now
        raw = self._raw
        self._raw = x_m, y_m, heading_rad
        if raw is None:
            self._now = Wheels(read_s)
            return self._now
        turned = math.remainder(heading_rad - raw[2], math.tau)
        dx = x_m - raw[0]
        dy = y_m - raw[1]
        passed_s = max(0.0, read_s - now.read_s)
        far = math.hypot(dx, dy) > _LEAP_M + 2 * self._speed_m_s * passed_s
        far |= abs(turned) > _LEAP_RAD + 2 * self._turn_rate_rad_s * passed_s
        if passed_s > self._silence_s:
            far |= _size(x_m, y_m, math.remainder(heading_rad, math.tau)) < _size(dx, dy, turned)
        if far:
            self.leaps += 1
            dx = dy = turned = 0.0
        # What was gone is seen from where the base stood, and laid on to where we say that it stood.
        by = now.heading_rad - raw[2]
        middle = raw[2] + turned / 2
        self._now = Wheels(
            read_s,
            now.x_m + dx * math.cos(by) - dy * math.sin(by),
            now.y_m + dx * math.sin(by) + dy * math.cos(by),
            math.remainder(now.heading_rad + turned, math.tau),
            now.ahead_m + dx * math.cos(middle) + dy * math.sin(middle),
            now.turned_rad + turned,
        )
        return self._now


def _size(x_m: float, y_m: float, angle_rad: float) -> float:
    return math.hypot(x_m / _LEAP_M, y_m / _LEAP_M, angle_rad / _LEAP_RAD)


def reading(now: Wheels, since: Wheels, last: Wheels) -> OdometryReading:
    """Return what the wheels say now, from where they were when an episode began, and when they were last read."""
    dx = now.x_m - since.x_m
    dy = now.y_m - since.y_m
    cos = math.cos(since.heading_rad)
    sin = math.sin(since.heading_rad)
    elapsed_s = now.read_s - last.read_s
    speed_m_s = (now.ahead_m - last.ahead_m) / elapsed_s if elapsed_s > 0 else 0.0
    turn_rad_s = (now.turned_rad - last.turned_rad) / elapsed_s if elapsed_s > 0 else 0.0
    return OdometryReading(
        _within(_MOST_M, dx * cos + dy * sin),
        _within(_MOST_M, dy * cos - dx * sin),
        math.remainder(now.heading_rad - since.heading_rad, math.tau),
        _within(_MOST_M_S, speed_m_s),
        _within(_MOST_RAD_S, turn_rad_s),
    )


def _within(most: float, value: float) -> float:
    return min(max(value, -most), most)
