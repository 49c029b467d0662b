"""Odometry of a real base, and its pose relative to an episode's start."""

import math
from collections import deque
from threading import Lock
from typing import Final, NamedTuple

from services.robot.body import OdometryReading

# Poses that differ by this much more than the base can move belong to odometry that was reset.
_LEAP_M = 0.3
_LEAP_RAD = 0.3
# Number of readings that are searched for the moment of a frame.
_KEPT: Final = 100
#: As in `schemas.motion`; far beyond any base.
_MOST_M = 1e6
_MOST_RAD_S = 100.0
_MOST_M_S = 100.0


class Wheels(NamedTuple):
    """Accumulated pose since the subscription, signed distance ahead, and angle turned."""

    # Time of the reading, by our clock.
    read_s: float
    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    ahead_m: float = 0.0
    turned_rad: float = 0.0


class WheelTrack:
    """Accumulates odometry poses without the leap when a base resets its odometry; thread-safe.

    At most twice the base's speeds are plausible. After `silence_s` the odometry can have been
    reset: it has if it is nearer to zero than to its previous pose.
    """

    def __init__(self, speed_m_s: float, turn_rate_rad_s: float, silence_s: float) -> None:
        self._silence_s = silence_s
        self._speed_m_s = speed_m_s
        self._turn_rate_rad_s = turn_rate_rad_s
        self._raw: tuple[float, float, float] | None = None
        self._now = Wheels(0.0)
        self._recent: deque[Wheels] = deque(maxlen=_KEPT)
        self._lock = Lock()
        self._since: Wheels | None = None
        self._last: Wheels | None = None
        self.leaps = 0

    def begin(self, at_s: float) -> None:
        """Begin an episode with the frame of a moment."""
        self._since = self._last = self.at(at_s)

    def reading(self, at_s: float) -> OdometryReading | None:
        """Return the odometry of a frame since the episode's start; None without odometry."""
        now = self.at(at_s)
        if now is None or self._since is None or self._last is None:
            return None
        last = self._last
        self._last = now
        return reading(now, self._since, last)

    def at(self, at_s: float) -> Wheels | None:
        """Return the odometry nearest to a moment."""
        with self._lock:
            return min(self._recent, key=lambda one: abs(one.read_s - at_s), default=None)

    def add(self, read_s: float, x_m: float, y_m: float, heading_rad: float) -> Wheels:
        """Add the next pose."""
        now = self._moved(read_s, x_m, y_m, heading_rad)
        with self._lock:
            self._recent.append(now)
        return now

    def _moved(self, read_s: float, x_m: float, y_m: float, heading_rad: float) -> Wheels:
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
        # Rotate the movement from the base's heading to the accumulated heading.
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
    """Return the odometry reading since an episode's start, with the latest speeds."""
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
