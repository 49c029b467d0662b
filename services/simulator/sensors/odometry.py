"""Wheel odometry: the pose that the wheels' encoders tell, if wheels and track were what they are believed to be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from services.robot.body import OdometryReading
from services.simulator.drive import WheelSpeeds, move
from services.simulator.world.place import Pose

if TYPE_CHECKING:
    import numpy as np

    from services.simulator.robots import Drive
    from services.simulator.sensors.step import Step


@dataclass(frozen=True)
class EncoderSettings:
    """Encoders on both wheels, and how well wheels and track were measured.

    Attributes
    ----------
    ticks_per_turn
        Counts in one turn of a wheel, greater than 0; the default is that of the TurtleBot II's base, a Kobuki: 11.7
        counts for each millimetre of its 70 mm wheels.
    radius_sigma
        Standard deviation of the relative error of each wheel's believed radius, drawn once an episode. Borenstein and
        Feng (1996) find about this much left on small robots that were calibrated.
    track_sigma
        The same for the believed distance between the wheels.
    """

    ticks_per_turn: float = 2578.33
    radius_sigma: float = 0.002
    track_sigma: float = 0.005


class Odometer:
    """Dead reckoning by the wheels' encoders.

    What the wheels do without turning (slipping, being pushed) stays unknown to it; and since it adds up what it reads,
    its error grows with the way.

    Parameters
    ----------
    drive
        The wheels as they are believed to be.
    settings
        Encoders and calibration.
    rng
        Source of this episode's errors of calibration.
    """

    def __init__(self, drive: Drive, settings: EncoderSettings, rng: np.random.Generator) -> None:
        self._tick_m = math.tau * drive.wheel_radius_m / settings.ticks_per_turn
        radii = 1.0 + settings.radius_sigma * rng.standard_normal(2)
        self._believed_m = self._tick_m * float(radii[0]), self._tick_m * float(radii[1])
        self._track_m = drive.track_m * (1.0 + settings.track_sigma * float(rng.standard_normal()))
        self._rolled_m = [0.0, 0.0]
        self._ticks = [0, 0]
        self._pose = Pose(0.0, 0.0, 0.0)
        self._ahead_m = self._turned_rad = self._elapsed_s = 0.0

    def step(self, step: Step) -> None:
        """Count the wheels' ticks of one step, and go by the arc that they make."""
        way_m = [self._count(wheel, rolled_m) for wheel, rolled_m in enumerate(step.rolled_m)]
        # For one second at this many metres a second: an arc knows of no time.
        self._pose = move(self._pose, WheelSpeeds(*way_m), self._track_m, 1.0)
        self._ahead_m += sum(way_m) / 2
        self._turned_rad += (way_m[1] - way_m[0]) / self._track_m
        self._elapsed_s += step.duration_s

    def read(self) -> OdometryReading:
        """Return the pose now, and the mean speeds since this was last called (0 where no time has passed)."""
        elapsed_s = self._elapsed_s or math.inf
        reading = OdometryReading(
            self._pose.x, self._pose.y, self._pose.heading, self._ahead_m / elapsed_s, self._turned_rad / elapsed_s
        )
        self._ahead_m = self._turned_rad = self._elapsed_s = 0.0
        return reading

    def _count(self, wheel: int, rolled_m: float) -> float:
        """Return the metres that a wheel seems to have rolled: whole ticks, the rest is seen in a later step."""
        self._rolled_m[wheel] += rolled_m
        # Without the margin, a sum of steps that should be a whole tick would often be a hair less.
        ticks = math.floor(self._rolled_m[wheel] / self._tick_m + 1e-6)
        new = ticks - self._ticks[wheel]
        self._ticks[wheel] = ticks
        return new * self._believed_m[wheel]
