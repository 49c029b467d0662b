"""Odometry of a base from its lines: poses, distances of the wheels, or speeds."""

import math
from collections.abc import Mapping
from typing import Final

from services.robot.clock import now_s
from services.robot.wheel_track import WheelTrack
from services.serial.config import SerialConfig

# Far beyond any base, its counters included.
_MOST: Final = 1e9


class LineOdometry:
    """Reads odometry lines; one thread calls ``take``."""

    def __init__(self, config: SerialConfig) -> None:
        self._template = None if config.odometry is None else config.odometry.template()
        self._track_m = config.base.track_m or math.inf
        self._silence_s = 0.0 if config.odometry is None else config.odometry.silence_s
        self.track = WheelTrack(config.speed_m_s, config.turn_rate_rad_s, self._silence_s)
        self._pose = (0.0, 0.0, 0.0)
        self._wheels: tuple[float, float] | None = None
        self._read_s: float | None = None
        self.readings = 0

    def take(self, line: str, arrived_s: float) -> None:
        """Take a line of the base."""
        if self._template is None:
            return
        values = self._template.read(line)
        if values is None or not all(abs(value) <= _MOST for value in values.values()):
            return
        self._pose = self._moved(values, arrived_s)
        self._read_s = arrived_s
        self.readings += 1
        self.track.add(arrived_s, *self._pose)

    def lacks(self) -> str | None:
        """Return why the required odometry is missing, or None."""
        if self._template is None:
            return None
        if self._read_s is None:
            return "no line of the base fits odometry.line"
        silence_s = now_s() - self._read_s
        return f"no odometry for {silence_s:.1f} s" if silence_s > self._silence_s else None

    def _moved(self, values: Mapping[str, float], at_s: float) -> tuple[float, float, float]:
        """Return the pose after a reading."""
        if "x_m" in values:
            return values["x_m"], values["y_m"], values["heading_rad"]
        ahead_m, turned_rad = self._step(values, at_s)
        x_m, y_m, heading_rad = self._pose
        middle_rad = heading_rad + turned_rad / 2
        return (
            x_m + ahead_m * math.cos(middle_rad),
            y_m + ahead_m * math.sin(middle_rad),
            heading_rad + turned_rad,
        )

    def _step(self, values: Mapping[str, float], at_s: float) -> tuple[float, float]:
        """Return the distance and the angle since the last reading."""
        if "left_m" in values:
            wheels = values["left_m"], values["right_m"]
            before = self._wheels or wheels
            self._wheels = wheels
            return self._of_wheels(wheels[0] - before[0], wheels[1] - before[1])
        elapsed_s = 0.0 if self._read_s is None else at_s - self._read_s
        if elapsed_s > self._silence_s:
            elapsed_s = 0.0  # The speed in between is unknown.
        if "left_m_s" in values:
            return self._of_wheels(values["left_m_s"] * elapsed_s, values["right_m_s"] * elapsed_s)
        return values["linear_m_s"] * elapsed_s, values["angular_rad_s"] * elapsed_s

    def _of_wheels(self, left_m: float, right_m: float) -> tuple[float, float]:
        return (left_m + right_m) / 2, (right_m - left_m) / self._track_m
