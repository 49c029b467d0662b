"""The robot's base: how its wheels are driven. This one is kinematic; `physics` has the one with mass."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np

from schemas.base import Velocity
from services.robot.clock import TICK_S
from services.simulator.robots import DriveTrain
from services.simulator.world.place import Place, Pose, Solid
from services.simulator.world.route import Obstacles, obstacles_of

#: Longest step of time that a base is moved by, seconds; sensors are read once a step, and real time goes by it.
STEP_S: Final = 0.02
# Halvings of a step that would collide: 2 m/s for 20 ms is 40 mm, a 64th of which is under a millimetre.
_HALVINGS: Final = 6


class WheelSpeeds(NamedTuple):
    """Speeds of the wheels' rims over the ground, m/s."""

    left: float
    right: float


def wheel_speeds(velocity: Velocity, drive: DriveTrain) -> WheelSpeeds:
    """Return the wheel speeds that a velocity commands."""
    ahead = velocity.linear * drive.speed_m_s
    half = velocity.angular * drive.turn_rate_rad_s * drive.track_m / 2
    return WheelSpeeds(ahead - half, ahead + half)


def move(pose: Pose, wheels: WheelSpeeds, track_m: float, duration_s: float) -> Pose:
    """Return the pose after constant speeds of the wheels (m/s): an arc of a circle, or a straight line, exactly."""
    half_turn = (wheels.right - wheels.left) / track_m * duration_s / 2
    # The chord of an arc points half the turn away from the heading and is sin(half)/half of the arc long.
    shrink = 1.0 - half_turn**2 / 6 if abs(half_turn) < 1e-4 else math.sin(half_turn) / half_turn
    chord = (wheels.left + wheels.right) / 2 * duration_s * shrink
    direction = pose.heading + half_turn
    heading = math.remainder(pose.heading + 2 * half_turn, math.tau)
    return Pose(pose.x + chord * math.cos(direction), pose.y + chord * math.sin(direction), heading)


class Actuator:
    """Wheels that do not quite obey; their errors belong to ticks of simulated time, however finely it is stepped."""

    def __init__(self, drive: DriveTrain, rng: np.random.Generator) -> None:
        self._drive = drive
        self._rng = rng
        self._radius = 1.0 + drive.radius_sigma * rng.standard_normal(2)
        self._time_s = 0.0
        self._tick = -1
        self._error = self._radius

    def wheels(self, velocity: Velocity, duration_s: float) -> WheelSpeeds:
        """Return the speeds that the wheels really have for the next `duration_s`, and let that time pass."""
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
    """What a base did in one step."""

    pose: Pose  # Where it is at the end of the step.
    rolled_m: tuple[
        float, float
    ]  # How far the left and the right wheel turned, as metres of the rim.
    collided: bool  # Whether it touched anything in this step.


class Base(Protocol):
    """What drives a robot in a place."""

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standing."""

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Let these stand in the way as well from the next ``put`` on, in the place of those before."""

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose; `rng` is the source of this episode's wheel errors."""

    def step(self, velocity: Velocity, duration_s: float) -> Motion:
        """Drive for up to `STEP_S`."""


class KinematicBase:
    """A base without mass, that has its wheels' speed at once and stops where it touches something."""

    braking_s = 0.0  # Seconds from nominal speed to standing.

    def __init__(self, place: Place, drive: DriveTrain | None = None) -> None:
        self._drive = drive or place.robot.drive
        self._place = place
        self._obstacles = obstacles_of(place)

    def obstruct(self, solids: Sequence[Solid]) -> None:
        """Let these stand in the way as well from the next ``put`` on, in the place of those before."""
        self._obstacles = Obstacles(self._place, solids) if solids else obstacles_of(self._place)

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose; `rng` is the source of this episode's wheel errors."""
        self._pose = pose
        self._actuator = Actuator(self._drive, rng)

    def step(self, velocity: Velocity, duration_s: float) -> Motion:
        """Go by the arc of the wheels' speeds for up to `STEP_S`; obstacles stop it."""
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
