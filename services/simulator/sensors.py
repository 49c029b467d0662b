"""What a robot senses besides its camera's picture: how the camera shakes, odometry, inertia."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.imu import MAX_SAMPLES
from services.robot.body import ImuReading, OdometryReading
from services.simulator.base import STEP_S, Motion, WheelSpeeds, move
from services.simulator.robots import Drive
from services.simulator.world.place import Pose

GRAVITY_M_S2: Final = 9.81
#: Inertial readings that are kept until somebody takes them.
MOST_READINGS: Final = MAX_SAMPLES
# Turning on the spot at the nominal rate shakes this much of what driving at the nominal speed does.
_TURNING: Final = 0.5
# The floor of a faster drive does not kick without limit.
_MOST_SHAKE: Final = 1.5
_EPS_S: Final = 1e-9


class Tilt(NamedTuple):
    """How a camera is turned against the level robot: about x (ahead), y (left), z (up), by the right hand.

    A positive roll lifts the left side, a positive pitch looks down, a positive yaw looks to the left.
    """

    roll_rad: float
    pitch_rad: float
    yaw_rad: float

    def matrix(self) -> NDArray[np.float64]:
        """Return the rotation (3, 3) that takes the camera's axes to the robot's: roll first, then pitch, then yaw."""
        return np.asarray(Rotation.from_euler("xyz", self).as_matrix(), dtype=np.float64)


class TiltRate(NamedTuple):
    """How fast a tilt changes, rad/s."""

    roll_rad_s: float
    pitch_rad_s: float
    yaw_rad_s: float


LEVEL: Final = Tilt(0.0, 0.0, 0.0)
STILL: Final = TiltRate(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Step:
    """How the robot moved from one reading of its sensors to the next: true poses, the wheels' rims, seconds."""

    before: Pose
    after: Pose
    rolled_m: tuple[float, float]
    duration_s: float

    @property
    def velocity_m_s(self) -> tuple[float, float]:
        """Mean velocity, east and north."""
        return (self.after.x - self.before.x) / self.duration_s, (self.after.y - self.before.y) / self.duration_s

    @property
    def turn_rate_rad_s(self) -> float:
        """Mean turn rate, anticlockwise."""
        return math.remainder(self.after.heading - self.before.heading, math.tau) / self.duration_s


@dataclass(frozen=True)
class ShakeSettings:
    """How much the camera shakes."""

    strength: float = 1.0
    """Factor on the three amplitudes; 0 is a camera that never shakes, 1 a TurtleBot on a floor that is not quite even.
    """
    roll_deg: float = 1.0
    pitch_deg: float = 1.0
    yaw_deg: float = 0.5
    """Standard deviation of each angle at the robot's nominal speed."""
    correlation_s: float = 0.1
    """How long a swing lasts: the integral of the angles' autocorrelation over positive lags."""
    exposure_s: float = 0.02
    """Time over which one picture collects light; what moves meanwhile is blurred."""


class Shake:
    """The tilt of a camera whose mast is a damped spring that the floor kicks while the robot moves.

    Each angle x is a critically damped oscillator, x'' + 2 k x' + k^2 x = noise, with k = 2 / `correlation_s`: the
    smoothest process of second order, so that it has a rate. The noise is as strong as the motion, so the robot's first
    metre builds the swinging up, and it dies away when the robot stands. It is stepped exactly, see `_propagation`.
    """

    def __init__(self, settings: ShakeSettings, drive: Drive, rng: np.random.Generator) -> None:
        self._drive = drive
        self._rng = rng
        self._stiffness = 2.0 / settings.correlation_s
        degrees = np.array([settings.roll_deg, settings.pitch_deg, settings.yaw_deg])
        self._amplitude = settings.strength * np.radians(degrees)
        # Angles in radians and their rates in rad/s, in units of the amplitude: (2, 3).
        self._state = np.zeros((2, 3))

    @property
    def tilt(self) -> Tilt:
        """The tilt now."""
        return Tilt(*(self._amplitude * self._state[0]).tolist())

    @property
    def rate(self) -> TiltRate:
        """How fast it changes now."""
        return TiltRate(*(self._amplitude * self._state[1]).tolist())

    def step(self, step: Step) -> None:
        """Let the time of one step pass."""
        swing, kick = _propagation(self._stiffness, step.duration_s)
        # 0 where the robot stands, 1 at its nominal speed straight ahead.
        speed = math.hypot(*step.velocity_m_s) / self._drive.speed_m_s
        turning = _TURNING * step.turn_rate_rad_s / self._drive.turn_rate_rad_s
        motion = min(math.hypot(speed, turning), _MOST_SHAKE)
        self._state = swing @ self._state + motion * (kick @ self._rng.standard_normal((2, 3)))


@lru_cache(maxsize=64)
def _propagation(stiffness: float, duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a step does to angle and rate (2, 2), and to independent unit noise (2, 2) that is added.

    In the long run the angle's variance is 1 and the rate's the square of the stiffness; the noise of a step is what
    the step takes from that.
    """
    k, t = stiffness, duration_s
    swing = math.exp(-k * t) * np.array([[1 + k * t, t], [-(k**2) * t, 1 - k * t]])
    stationary = np.diag([1.0, k**2])
    kick = np.linalg.cholesky(stationary - swing @ stationary @ swing.T)
    return swing, np.asarray(kick, dtype=np.float64)


@dataclass(frozen=True)
class ImuSettings:
    """Noise and range, gyroscope first, as calibration tools state them.

    The defaults are those of the ADIS16448 in the EuRoC data set (Burri and others, 2016), in the middle of what the
    sensors of small robots have; biases at switching on are after a short calibration at rest.
    """

    density: tuple[float, float] = (1.6968e-4, 2.0e-3)
    """Of the white noise: rad/s and m/s^2, each by the root of a hertz."""
    walk: tuple[float, float] = (1.9393e-5, 3.0e-3)
    """Density of the white noise that the bias is the sum of: rad/s^2 and m/s^3, each by the root of a hertz."""
    bias: tuple[float, float] = (1e-3, 0.02)
    """Standard deviation of each axis's bias at the start of an episode, rad/s and m/s^2."""
    greatest: tuple[float, float] = (math.radians(2000), 16 * GRAVITY_M_S2)
    """Greatest reading, rad/s and m/s^2."""


class InertialUnit:
    """A gyroscope and an accelerometer over the middle of the wheels' axis, on what the camera shakes with."""

    def __init__(self, settings: ImuSettings, rng: np.random.Generator) -> None:
        self._rng = rng
        self._density, self._walk, self._range = (
            np.repeat(pair, 3) for pair in (settings.density, settings.walk, settings.greatest)
        )
        self._bias = np.repeat(settings.bias, 3) * rng.standard_normal(6)
        self._velocity_m_s = (0.0, 0.0)
        self._time_s = 0.0

    def step(self, step: Step, tilt: Tilt, rate: TiltRate) -> ImuReading:
        """Return the reading at the end of a step.

        The turn rate is the mean over the step, the acceleration the mean from its middle back to the middle of the
        step before. For a tilt of a few degrees the axes of turning are those of the level robot.
        """
        self._time_s += step.duration_s
        noise = self._density / math.sqrt(step.duration_s) * self._rng.standard_normal(6)
        self._bias += self._walk * math.sqrt(step.duration_s) * self._rng.standard_normal(6)
        turning = [rate.roll_rad_s, rate.pitch_rad_s, rate.yaw_rad_s + step.turn_rate_rad_s]
        true = np.concatenate([turning, self._acceleration(step, tilt)])
        read = np.clip(true + self._bias + noise, -self._range, self._range)
        gx, gy, gz, ax, ay, az = read.tolist()
        return ImuReading(self._time_s, (gx, gy, gz), (ax, ay, az))

    def _acceleration(self, step: Step, tilt: Tilt) -> NDArray[np.float64]:
        """Return what an accelerometer feels (3,), m/s^2: it is pushed by the ground as if it fell upwards."""
        before, self._velocity_m_s = self._velocity_m_s, step.velocity_m_s
        east, north = (np.subtract(self._velocity_m_s, before) / step.duration_s).tolist()
        cos, sin = math.cos(step.before.heading), math.sin(step.before.heading)
        level = np.array([east * cos + north * sin, north * cos - east * sin, GRAVITY_M_S2])
        return np.asarray(tilt.matrix().T @ level, dtype=np.float64)


@dataclass(frozen=True)
class EncoderSettings:
    """Encoders on both wheels, and how well wheels and track were measured.

    Borenstein and Feng (1996) find about this much error left on small robots that were calibrated.
    """

    ticks_per_turn: float = 2578.33
    """Counts in one turn of a wheel; the default is that of the TurtleBot II's base, a Kobuki: 11.7 counts for each
    millimetre of its 70 mm wheels."""
    radius_sigma: float = 0.002
    """Standard deviation of the relative error of each wheel's believed radius, drawn once an episode."""
    track_sigma: float = 0.005
    """The same for the believed distance between the wheels."""


class Odometer:
    """Dead reckoning by the wheels' encoders, as if wheels and track were what they are believed to be.

    What the wheels do without turning (slipping, being pushed) stays unknown to it; and since it adds up what it reads,
    its error grows with the way.
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
        speeds = self._ahead_m / elapsed_s, self._turned_rad / elapsed_s
        self._ahead_m = self._turned_rad = self._elapsed_s = 0.0
        return OdometryReading(self._pose.x, self._pose.y, self._pose.heading, *speeds)

    def _count(self, wheel: int, rolled_m: float) -> float:
        """Return the metres that a wheel seems to have rolled: whole ticks, the rest is seen in a later step."""
        self._rolled_m[wheel] += rolled_m
        # Without the margin, a sum of steps that should be a whole tick would often be a hair less.
        ticks = math.floor(self._rolled_m[wheel] / self._tick_m + 1e-6)
        new, self._ticks[wheel] = ticks - self._ticks[wheel], ticks
        return new * self._believed_m[wheel]


class Sensors:
    """Odometry, inertial unit and shaking camera of one robot.

    A reading is taken every `STEP_S` of simulated time, however finely the robot is moved between.
    """

    def __init__(
        self,
        drive: Drive,
        shake: ShakeSettings,
        encoders: EncoderSettings = EncoderSettings(),
        imu: ImuSettings = ImuSettings(),
    ) -> None:
        self._drive = drive
        self._settings = shake, encoders, imu

    def begin(
        self, start: Pose, odometry: np.random.Generator, imu: np.random.Generator, shake: np.random.Generator
    ) -> None:
        """Begin an episode at a pose; each sensor has a source of noise of its own, so that none changes another's."""
        shaking, encoders, unit = self._settings
        self._pose = start
        self._rolled_m = (0.0, 0.0)
        self._elapsed_s = 0.0
        self._odometer = Odometer(self._drive, encoders, odometry)
        self._unit = InertialUnit(unit, imu)
        self._shake = Shake(shaking, self._drive, shake)
        self._readings: deque[ImuReading] = deque(maxlen=MOST_READINGS)

    def feel(self, motion: Motion, duration_s: float) -> None:
        """Feel what the base did in `duration_s`, greater than 0."""
        self._rolled_m = (self._rolled_m[0] + motion.rolled_m[0], self._rolled_m[1] + motion.rolled_m[1])
        self._elapsed_s += duration_s
        if self._elapsed_s < STEP_S - _EPS_S:
            return
        step = Step(self._pose, motion.pose, self._rolled_m, self._elapsed_s)
        self._pose, self._rolled_m, self._elapsed_s = motion.pose, (0.0, 0.0), 0.0
        self._odometer.step(step)
        self._shake.step(step)
        self._readings.append(self._unit.step(step, self.tilt, self.tilt_rate))

    @property
    def tilt(self) -> Tilt:
        """How the camera is tilted now."""
        return self._shake.tilt

    @property
    def tilt_rate(self) -> TiltRate:
        """How fast that changes."""
        return self._shake.rate

    def odometry(self) -> OdometryReading:
        """Return where the wheels say that the robot is, and its mean speeds since this was last called."""
        return self._odometer.read()

    def imu(self) -> tuple[ImuReading, ...]:
        """Return the inertial readings since this was last called, oldest first, at most the last `MOST_READINGS`."""
        readings = tuple(self._readings)
        self._readings.clear()
        return readings
