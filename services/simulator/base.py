"""Interface of the robot's base, and a kinematic base; `physics` has a base with mass."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np

from schemas.base import TICK_S, Velocity
from services.simulator.robots import DriveTrain
from services.simulator.world.place import Place, Pose, Solid
from services.simulator.world.route import Obstacles, obstacles_of

#: Longest time step of a base, seconds. Sensors are read once a step.
STEP_S: Final = 0.02
# Halvings of a colliding step: 2 m/s for 20 ms is 40 mm, and 1/64 of 40 mm is under a millimetre.
_HALVINGS: Final = 6


class WheelSpeeds(NamedTuple):
    """Rim speeds of the two wheels, m/s."""

    left: float
    right: float


def wheel_speeds(velocity: Velocity, drive: DriveTrain) -> WheelSpeeds:
    """Compute the wheel speeds for a velocity."""
    ahead = velocity.linear * drive.speed_m_s
    half = velocity.angular * drive.turn_rate_rad_s * drive.track_m / 2
    return WheelSpeeds(ahead - half, ahead + half)


def move(pose: Pose, wheels: WheelSpeeds, track_m: float, duration_s: float) -> Pose:
    """Integrate constant wheel speeds (m/s) over a duration, exactly along an arc or a line."""
    half_turn = (wheels.right - wheels.left) / track_m * duration_s / 2
    # The chord points half the turn away from the heading; its length is the arc times
    # sin(half)/half.
    shrink = 1.0 - half_turn**2 / 6 if abs(half_turn) < 1e-4 else math.sin(half_turn) / half_turn
    chord = (wheels.left + wheels.right) / 2 * duration_s * shrink
    direction = pose.heading + half_turn
    heading = math.remainder(pose.heading + 2 * half_turn, math.tau)
    return Pose(pose.x + chord * math.cos(direction), pose.y + chord * math.sin(direction), heading)


class Actuator:
    """Wheels with random speed errors, drawn once for each tick of simulated time."""

    def __init__(self, drive: DriveTrain, rng: np.random.Generator) -> None:
        self._drive = drive
        self._rng = rng
        self._radius = 1.0 + drive.radius_sigma * rng.standard_normal(2)
        self._time_s = 0.0
        self._tick = -1
        self._error = self._radius

    def wheels(self, velocity: Velocity, duration_s: float) -> WheelSpeeds:
        """Advance time by `duration_s` and return the speeds that the wheels really have."""
        tick = int(self._time_s / TICK_S + 1e-6)
        while self._tick < tick:
            self._tick += 1
            self._error = self._radius * (
                1.0 + self._drive.tick_sigma * self._rng.standard_normal(2)
            )
        self._time_s += duration_s
        wanted = wheel_speeds(velocity, self._drive)
        return WheelSpeeds(
            wanted.left * float(self._error[0]), wanted.right * float(self._error[1])
        )


class Motion(NamedTuple):
    """Result of one step of a base."""

    pose: Pose  # Pose at the end of the step.
    # Distance that the rims of the left and the right wheel rolled.
    rolled_m: tuple[float, float]
    collided: bool  # Whether the robot touched an obstacle in this step.


class Base(Protocol):
    """Interface of a robot base in a place."""

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standstill."""

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Replace the additional obstacles, effective at the next ``put``."""

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Place the robot at rest; `rng` draws the wheel errors of this episode."""

    def step(self, velocity: Velocity, duration_s: float) -> Motion:
        """Drive for at most `STEP_S`."""


class KinematicBase:
    """A base without mass: wheels reach their speed immediately, obstacles stop them."""

    braking_s = 0.0  # Seconds from nominal speed to standstill.

    def __init__(self, place: Place, drive: DriveTrain | None = None) -> None:
        self._drive = drive or place.robot.drive
        self._place = place
        self._obstacles = obstacles_of(place)

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Replace the additional obstacles, effective at the next ``put``."""
        self._obstacles = Obstacles(self._place, solids) if solids else obstacles_of(self._place)

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Place the robot at rest; `rng` draws the wheel errors of this episode."""
        self._pose = pose
        self._actuator = Actuator(self._drive, rng)

    def step(self, velocity: Velocity, duration_s: float) -> Motion:
        """Drive along the arc of the wheel speeds for at most `STEP_S`, or to an obstacle."""
        wheels = self._actuator.wheels(velocity, duration_s)
        collided = not self._advance(wheels, duration_s)
        if collided:
            for _ in range(_HALVINGS):
                duration_s /= 2
                self._advance(wheels, duration_s)
        return Motion(self._pose, (wheels.left * duration_s, wheels.right * duration_s), collided)

    def _advance(self, wheels: WheelSpeeds, duration_s: float) -> bool:
        ahead = move(self._pose, wheels, self._drive.track_m, duration_s)
        free = self._obstacles.is_free(ahead.x, ahead.y)
        if free:
            self._pose = ahead
        return free
