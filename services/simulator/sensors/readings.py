"""What a robot senses besides its camera's picture: how the camera shakes, odometry, inertia."""

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

# The shake: standard deviation of roll, pitch and yaw at the robot's nominal speed on a floor that is not quite even,
# and how long a swing lasts, the integral of the angles' autocorrelation over positive lags.
_SHAKE_RAD: Final = np.radians([1.0, 1.0, 0.5])
_SWING_S: Final = 0.1
# Turning on the spot at the nominal rate shakes this much of what driving at the nominal speed does.
_TURNING: Final = 0.5
# The floor of a faster drive does not kick without limit.
_MOST_SHAKE: Final = 1.5

# The inertial unit is the ADIS16448 of the EuRoC data set (Burri and others, 2016), in the middle of what small robots
# have. Of the gyroscope's three axes, in rad/s, and the accelerometer's, in m/s^2: densities of the white noise and of
# the noise that the bias is the sum of, each by the root of a hertz; bias after a calibration; greatest reading.
_NOISE: Final = np.repeat([1.6968e-4, 2.0e-3], 3)
_WALK: Final = np.repeat([1.9393e-5, 3.0e-3], 3)
_BIAS: Final = np.repeat([1e-3, 0.02], 3)
_GREATEST: Final = np.repeat([math.radians(2000), 16 * GRAVITY_M_S2], 3)

# The wheels' encoders are those of the TurtleBot II's base, a Kobuki: 11.7 counts for each millimetre of its wheels.
_TICKS_PER_TURN: Final = 2578.33
# Relative errors of each wheel's believed radius and of the distance between them, drawn once an episode: about what
# Borenstein and Feng (1996) find left on small robots that were calibrated.
_RADIUS_SIGMA: Final = 0.002
_TRACK_SIGMA: Final = 0.005


class Tilt(NamedTuple):
    """How a camera is turned against the level robot, radians; or how fast that changes, rad/s.

    About x (ahead), y (left), z (up), by the right hand: a positive roll lifts the left side, a positive pitch looks
    down, a positive yaw looks to the left.
    """

    roll: float
    pitch: float
    yaw: float

    def matrix(self) -> NDArray[np.float64]:
        """Return the rotation (3, 3) that takes the camera's axes to the robot's: roll first, then pitch, then yaw."""
        return np.asarray(Rotation.from_euler("xyz", self).as_matrix(), dtype=np.float64)


LEVEL: Final = Tilt(0.0, 0.0, 0.0)


class Shake:
    """The tilt of a camera whose mast is a damped spring that the floor kicks while the robot moves.

    Each angle x is a critically damped oscillator, x'' + 2 k x' + k^2 x = noise, with k = 2 / `_SWING_S`: the smoothest
    process of second order, so that it has a rate. The noise is as strong as the motion, so the robot's first metre
    builds the swinging up, and it dies away when the robot stands. It is stepped exactly, see `_propagation`.
    """

    def __init__(self, strength: float, drive: DriveTrain, rng: np.random.Generator) -> None:
        self._amplitude = strength * _SHAKE_RAD
        self._drive = drive
        self._rng = rng
        # Angles, and their rates by the second, in units of the amplitude: (2, 3).
        self._state = np.zeros((2, 3))
        self.tilt = self.rate = LEVEL

    def step(self, velocity_m_s: Velocity, turn_rate_rad_s: float, duration_s: float) -> None:
        """Let time pass in which the robot moves so."""
        swing, kick = _propagation(duration_s)
        # 0 where the robot stands, 1 at its nominal speed straight ahead.
        speed = math.hypot(*velocity_m_s) / self._drive.speed_m_s
        turning = _TURNING * turn_rate_rad_s / self._drive.turn_rate_rad_s
        motion = min(math.hypot(speed, turning), _MOST_SHAKE)
        self._state = swing @ self._state + motion * (kick @ self._rng.standard_normal((2, 3)))
        self.tilt, self.rate = (Tilt(*row) for row in (self._amplitude * self._state).tolist())


@lru_cache(maxsize=64)
def _propagation(duration_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a step does to angle and rate (2, 2), and to independent unit noise (2, 2) that is added.

    In the long run the angle's variance is 1 and the rate's the square of the stiffness; the noise of a step is what
    the step takes from that.
    """
    k = 2.0 / _SWING_S
    t = duration_s
    swing = math.exp(-k * t) * np.array([[1 + k * t, t], [-(k**2) * t, 1 - k * t]])
    stationary = np.diag([1.0, k**2])
    kick = np.linalg.cholesky(stationary - swing @ stationary @ swing.T)
    return swing, np.asarray(kick, dtype=np.float64)


class InertialUnit:
    """A gyroscope and an accelerometer over the middle of the wheels' axis, on what the camera shakes with."""

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
        """Return the reading after a step that began with a heading.

        The turn rate is the mean over the step, the acceleration the mean from its middle back to the middle of the
        step before. For a tilt of a few degrees the axes of turning are those of the level robot.
        """
        self._time_s += duration_s
        noise = self._error * _NOISE / math.sqrt(duration_s) * self._rng.standard_normal(6)
        self._bias += self._error * _WALK * math.sqrt(duration_s) * self._rng.standard_normal(6)
        before = self._velocity_m_s
        self._velocity_m_s = velocity_m_s
        east, north = (np.subtract(velocity_m_s, before) / duration_s).tolist()
        cos = math.cos(heading)
        sin = math.sin(heading)
        # It is pushed by the ground as if it fell upwards.
        level = np.array([east * cos + north * sin, north * cos - east * sin, GRAVITY_M_S2])
        true = np.concatenate(
            [[rate.roll, rate.pitch, rate.yaw + turn_rate_rad_s], tilt.matrix().T @ level]
        )
        gx, gy, gz, ax, ay, az = np.clip(true + self._bias + noise, -_GREATEST, _GREATEST).tolist()
        return ImuReading(self._time_s, (gx, gy, gz), (ax, ay, az))


class Odometer:
    """Dead reckoning by the wheels' encoders, as if wheels and track were what they are believed to be.

    What the wheels do without turning (slipping, being pushed) stays unknown to it; and since it adds up what it reads,
    its error grows with the way.
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
        """Count the wheels' ticks of one step, and go by the arc that they make."""
        way_m = [self._count(wheel, rim_m) for wheel, rim_m in enumerate(rolled_m)]
        # For one second at this many metres a second: an arc knows of no time.
        self._pose = move(self._pose, WheelSpeeds(*way_m), self._track_m, 1.0)
        self._ahead_m += sum(way_m) / 2
        self._turned_rad += (way_m[1] - way_m[0]) / self._track_m
        self._elapsed_s += duration_s

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
        new = ticks - self._ticks[wheel]
        self._ticks[wheel] = ticks
        return new * self._believed_m[wheel]


class Sensors:
    """Odometry, inertial unit and shaking camera of one robot.

    A reading is taken every `STEP_S` of simulated time, however finely the robot is moved between. `shake` is a factor
    on how much the camera shakes, 1 on a floor that is not quite even; `error` one on what the others measure wrong.
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
        """Begin an episode at a pose; each sensor has a source of noise of its own, so that none changes another's."""
        self._pose = start
        self._rolled_m = (0.0, 0.0)
        self._elapsed_s = 0.0
        self.odometer = Odometer(self._drive, self._error, odometry)
        self._unit = InertialUnit(self._error, imu)
        self.shake = Shake(self._strength, self._drive, shake)
        self._readings: deque[ImuReading] = deque(maxlen=MAX_SAMPLES)

    def feel(self, motion: Motion, duration_s: float) -> None:
        """Feel what the base did in `duration_s`, greater than 0."""
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
        """Return the inertial readings since this was last called, oldest first, at most the last `MAX_SAMPLES`."""
        readings = tuple(self._readings)
        self._readings.clear()
        return readings
