"""How the wheels of a two-wheel robot are driven: atom movements, wheel speeds with seeded errors, exact arcs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from services.robot.clock import TICK_S
from services.simulator.world.place import Pose

if TYPE_CHECKING:
    import numpy as np

    from schemas.base import Atom
    from services.simulator.robots import Drive


class WheelSpeeds(NamedTuple):
    """Speeds of the wheels' rims over the ground, m/s."""

    left: float
    right: float


def wheel_speeds(atom: Atom, drive: Drive, speed: float = 1.0) -> WheelSpeeds:
    """Return the wheel speeds that an atom movement commands at a fraction `speed`, 0 to 1, of the nominal speed."""
    forward = {"forward": drive.speed_m_s, "backward": -drive.speed_m_s}.get(atom, 0.0)
    turn = {"left": drive.turn_rate_rad_s, "right": -drive.turn_rate_rad_s}.get(atom, 0.0)
    half = turn * drive.track_m / 2
    return WheelSpeeds(speed * (forward - half), speed * (forward + half))


def move(pose: Pose, wheels: WheelSpeeds, track_m: float, duration_s: float) -> Pose:
    """Return the pose after constant wheel speeds, exactly: an arc of a circle, or a straight line.

    Parameters
    ----------
    pose
        Where the movement begins.
    wheels
        Speeds of the left and right wheel, m/s.
    track_m
        Distance between the wheels, greater than 0.
    duration_s
        How long, at least 0.

    Returns
    -------
    The pose at the end, heading in (-pi, pi].
    """
    half_turn = (wheels.right - wheels.left) / track_m * duration_s / 2
    # The chord of an arc points half the turn away from the heading and is sin(half)/half of the arc long.
    shrink = 1.0 - half_turn**2 / 6 if abs(half_turn) < 1e-4 else math.sin(half_turn) / half_turn
    chord = (wheels.left + wheels.right) / 2 * duration_s * shrink
    direction = pose.heading + half_turn
    heading = math.remainder(pose.heading + 2 * half_turn, math.tau)
    return Pose(pose.x + chord * math.cos(direction), pose.y + chord * math.sin(direction), heading)


class Actuator:
    """Wheels that do not quite obey, in the same way for the same seed.

    The errors belong to ticks of simulated time, so that a movement does not depend on how finely it is stepped.
    """

    def __init__(self, drive: Drive, rng: np.random.Generator) -> None:
        self._drive = drive
        self._rng = rng
        self._radius = 1.0 + drive.radius_sigma * rng.standard_normal(2)
        self._time_s = 0.0
        self._tick = -1
        self._error = self._radius

    def wheels(self, atom: Atom, speed: float, duration_s: float) -> WheelSpeeds:
        """Return the speeds that the wheels really have for the next `duration_s`, and let that time pass."""
        tick = int(self._time_s / TICK_S + 1e-6)
        while self._tick < tick:
            self._tick += 1
            self._error = self._radius * (1.0 + self._drive.tick_sigma * self._rng.standard_normal(2))
        self._time_s += duration_s
        wanted = wheel_speeds(atom, self._drive, speed)
        return WheelSpeeds(wanted.left * float(self._error[0]), wanted.right * float(self._error[1]))
