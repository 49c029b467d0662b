"""Camera shake, odometry and inertial readings of the robot."""

import math
from collections import deque
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.motion import MAX_SAMPLES
from services.robot.body import ImuReading, OdometryReading
from services.simulator.base import STEP_S, Motion, WheelSpeeds, move
from services.simulator.robots import DriveTrain
from services.simulator.world.place import Pose

GRAVITY_M_S2: Final = 9.81
Velocity = tuple[float, float]  # East and north.

# Shake: standard deviation of roll, pitch and yaw at nominal speed on a slightly uneven floor, and
# its correlation time (integral of the angles' autocorrelation over positive lags).
_SHAKE_RAD: Final = np.radians([1.0, 1.0, 0.5])
_SWING_S: Final = 0.1
# Shake in turning on the spot at the nominal rate, relative to driving at nominal speed.
_TURNING: Final = 0.5
# Limit of the excitation at higher speeds.
_MOST_SHAKE: Final = 1.5

# Noise model of the ADIS16448 in the EuRoC data set (Burri et al., 2016), a medium-quality unit on
# small robots. For three gyroscope axes (rad/s) and the accelerometer (m/s^2): densities of the
# white noise and of the bias random walk (by the root of a hertz), bias after calibration, range.
_NOISE: Final = np.repeat([1.6968e-4, 2.0e-3], 3)
_WALK: Final = np.repeat([1.9393e-5, 3.0e-3], 3)
_BIAS: Final = np.repeat([1e-3, 0.02], 3)
_GREATEST: Final = np.repeat([math.radians(2000), 16 * GRAVITY_M_S2], 3)

# Encoders of the Kobuki base (TurtleBot II): 11.7 counts for each millimetre of wheel travel.
_TICKS_PER_TURN: Final = 2578.33
# Relative errors of the assumed wheel radius and track, drawn once an episode: about the residual
# of calibrated small robots in Borenstein and Feng (1996).
_RADIUS_SIGMA: Final = 0.002
_TRACK_SIGMA: Final = 0.005


class Tilt(NamedTuple):
    """Rotation of the camera against the level robot, radians, or its rate, rad/s.

    Right-handed about x (ahead), y (left) and z (up): positive roll lifts the left side, positive
    pitch points down, positive yaw points left.
    """

    roll: float
    pitch: float
    yaw: float

    def matrix(self) -> NDArray[np.float64]:
        """Return the rotation (3, 3) from camera to robot axes: roll, then pitch, then yaw."""
        return np.asarray(Rotation.from_euler("xyz", self).as_matrix(), dtype=np.float64)


LEVEL: Final = Tilt(0.0, 0.0, 0.0)


class Shake:
    """Camera tilt on a mast modelled as a damped spring, excited by the floor.

    Each angle x is a critically damped oscillator, x'' + 2 k x' + k^2 x = noise, with k = 2 /
    `_SWING_S`: the smoothest second-order process, so that it has a rate. The noise is proportional
    to the motion: the swing builds up over the first metre and dies away at rest. Steps are exact,
    see `_propagation`.
    """

    def __init__(self, strength: float, drive: DriveTrain, rng: np.random.Generator) -> None:
        self._amplitude = strength * _SHAKE_RAD
        self._drive = drive
        self._rng = rng
        # Angles, and their rates by the second, in units of the amplitude: (2, 3).
        self._state = np.zeros((2, 3))
        self.tilt = self.rate = LEVEL

    def step(self, velocity_m_s: Velocity, turn_rate_rad_s: float, duration_s: float) -> None:
        """Advance time while the robot moves at this velocity."""
        swing, kick = _propagation(duration_s)
        # 0 at rest, 1 at nominal speed straight ahead.
        speed = math.hypot(*velocity_m_s) / self._drive.speed_m_s
        turning = _TURNING * turn_rate_rad_s / self._drive.turn_rate_rad_s
        motion = min(math.hypot(speed, turning), _MOST_SHAKE)
        self._state = swing @ self._state + motion * (kick @ self._rng.standard_normal((2, 3)))
        self.tilt, self.rate = (Tilt(*row) for row in (self._amplitude * self._state).tolist())


@lru_cache(maxsize=64)
def _propagation(duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the transition (2, 2) of angle and rate, and the noise factor (2, 2).

    In the stationary state the variance of the angle is 1 and of the rate the squared stiffness.
    The noise of a step restores the variance that the transition removes.
    """
    k = 2.0 / _SWING_S
    t = duration_s
    swing = math.exp(-k * t) * np.array([[1 + k * t, t], [-(k**2) * t, 1 - k * t]])
    stationary = np.diag([1.0, k**2])
    kick = np.linalg.cholesky(stationary - swing @ stationary @ swing.T)
    return swing, np.asarray(kick, dtype=np.float64)


class InertialUnit:
    """A gyroscope and an accelerometer above the wheels' axis, on the shaking mast."""

    def __init__(self, error: float, rng: np.random.Generator) -> None:
        self._error = error
        self._rng = rng
        self._bias = error * _BIAS * rng.standard_normal(6)
        self._velocity_m_s = (0.0, 0.0)
        self._time_s = 0.0

    def step(
        self,
        heading: float,
        velocity_m_s: Velocity,
        turn_rate_rad_s: float,
        duration_s: float,
        tilt: Tilt,
        rate: Tilt,
    ) -> ImuReading:
        """Compute the reading after a step that began at `heading`.

        The turn rate is the mean over the step. The acceleration is the mean between the middles of
        the last two steps. For tilts of a few degrees the rotation axes are the level robot's.
        """
        self._time_s += duration_s
        noise = self._error * _NOISE / math.sqrt(duration_s) * self._rng.standard_normal(6)
        self._bias += self._error * _WALK * math.sqrt(duration_s) * self._rng.standard_normal(6)
        before = self._velocity_m_s
        self._velocity_m_s = velocity_m_s
        east, north = (np.subtract(velocity_m_s, before) / duration_s).tolist()
        cos = math.cos(heading)
        sin = math.sin(heading)
        # Gravity reads as an upward acceleration.
        level = np.array([east * cos + north * sin, north * cos - east * sin, GRAVITY_M_S2])
        true = np.concatenate(
            [[rate.roll, rate.pitch, rate.yaw + turn_rate_rad_s], tilt.matrix().T @ level]
        )
        gx, gy, gz, ax, ay, az = np.clip(true + self._bias + noise, -_GREATEST, _GREATEST).tolist()
        return ImuReading(self._time_s, (gx, gy, gz), (ax, ay, az))


class Odometer:
    """Dead reckoning from wheel encoders with the assumed wheel radius and track.

    Slip and pushes stay unobserved, and the error grows with the distance, since readings are
    integrated.
    """

    def __init__(self, drive: DriveTrain, error: float, rng: np.random.Generator) -> None:
        self._tick_m = math.tau * drive.wheel_radius_m / _TICKS_PER_TURN
        radii = 1.0 + error * _RADIUS_SIGMA * rng.standard_normal(2)
        self._believed_m = self._tick_m * float(radii[0]), self._tick_m * float(radii[1])
        self._track_m = drive.track_m * (1.0 + error * _TRACK_SIGMA * float(rng.standard_normal()))
        self._rolled_m = [0.0, 0.0]
        self._ticks = [0, 0]
        self._pose = Pose(0.0, 0.0, 0.0)
        self._ahead_m = self._turned_rad = self._elapsed_s = 0.0

    def step(self, rolled_m: tuple[float, float], duration_s: float) -> None:
        """Integrate the wheel ticks of one step along an arc."""
        way_m = [self._count(wheel, rim_m) for wheel, rim_m in enumerate(rolled_m)]
        # Metres of one step used as m/s over one second: an arc does not depend on time.
        self._pose = move(self._pose, WheelSpeeds(*way_m), self._track_m, 1.0)
        self._ahead_m += sum(way_m) / 2
        self._turned_rad += (way_m[1] - way_m[0]) / self._track_m
        self._elapsed_s += duration_s

    def read(self) -> OdometryReading:
        """Return the current pose, and the mean speeds since the last call."""
        elapsed_s = self._elapsed_s or math.inf
        speeds = self._ahead_m / elapsed_s, self._turned_rad / elapsed_s
        self._ahead_m = self._turned_rad = self._elapsed_s = 0.0
        return OdometryReading(self._pose.x, self._pose.y, self._pose.heading, *speeds)

    def _count(self, wheel: int, rolled_m: float) -> float:
        """Return the distance in whole encoder ticks; the remainder counts in a later step."""
        self._rolled_m[wheel] += rolled_m
        # Margin for rounding: a sum of steps that equals a whole tick is often slightly less.
        ticks = math.floor(self._rolled_m[wheel] / self._tick_m + 1e-6)
        new = ticks - self._ticks[wheel]
        self._ticks[wheel] = ticks
        return new * self._believed_m[wheel]


class Sensors:
    """Odometry, inertial unit and camera shake of one robot.

    Readings are taken every `STEP_S` of simulated time. `shake` scales the camera shake (1 =
    slightly uneven floor), `error` scales the errors of the other sensors.
    """

    def __init__(self, drive: DriveTrain, shake: float, error: float = 1.0) -> None:
        self._drive = drive
        self._strength = shake
        self._error = error

    def begin(
        self,
        start: Pose,
        odometry: np.random.Generator,
        imu: np.random.Generator,
        shake: np.random.Generator,
    ) -> None:
        """Begin an episode at a pose; each sensor has an independent noise source."""
        self._pose = start
        self._rolled_m = (0.0, 0.0)
        self._elapsed_s = 0.0
        self.odometer = Odometer(self._drive, self._error, odometry)
        self._unit = InertialUnit(self._error, imu)
        self.shake = Shake(self._strength, self._drive, shake)
        self._readings: deque[ImuReading] = deque(maxlen=MAX_SAMPLES)

    def feel(self, motion: Motion, duration_s: float) -> None:
        """Update the sensors after a motion of `duration_s`, greater than 0."""
        self._rolled_m = (
            self._rolled_m[0] + motion.rolled_m[0],
            self._rolled_m[1] + motion.rolled_m[1],
        )
        self._elapsed_s += duration_s
        if self._elapsed_s < STEP_S - 1e-9:
            return
        before = self._pose
        after = motion.pose
        step_s = self._elapsed_s
        velocity_m_s = (after.x - before.x) / step_s, (after.y - before.y) / step_s
        moved = (
            velocity_m_s,
            math.remainder(after.heading - before.heading, math.tau) / step_s,
            step_s,
        )
        self.odometer.step(self._rolled_m, step_s)
        self.shake.step(*moved)
        self._readings.append(
            self._unit.step(before.heading, *moved, self.shake.tilt, self.shake.rate)
        )
        self._pose = after
        self._rolled_m = (0.0, 0.0)
        self._elapsed_s = 0.0

    def imu(self) -> tuple[ImuReading, ...]:
        """Return the newest inertial readings since the last call, oldest first."""
        readings = tuple(self._readings)
        self._readings.clear()
        return readings
