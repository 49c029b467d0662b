"""Every sensor that feels the robot move, read on one grid of simulated time."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from schemas.imu import MAX_SAMPLES
from services.simulator.base import STEP_S
from services.simulator.sensors.imu import ImuSettings, InertialUnit
from services.simulator.sensors.odometry import EncoderSettings, Odometer
from services.simulator.sensors.shake import Shake, ShakeSettings, Tilt, TiltRate
from services.simulator.sensors.step import Step

if TYPE_CHECKING:
    import numpy as np

    from services.robot.body import ImuReading, OdometryReading
    from services.simulator.base import Motion
    from services.simulator.robots import Drive
    from services.simulator.world.place import Pose

#: Inertial readings that are kept until somebody takes them.
MOST_READINGS: Final = MAX_SAMPLES
_EPS_S: Final = 1e-9


class Sensors:
    """Odometry, inertial unit and shaking camera of one robot.

    A reading is taken every `STEP_S` of simulated time, however finely the robot is moved between.

    Parameters
    ----------
    drive
        The robot's wheels.
    shake
        How much its camera shakes.
    encoders, imu
        Other sensors than the usual ones.
    """

    def __init__(
        self,
        drive: Drive,
        shake: ShakeSettings,
        encoders: EncoderSettings | None = None,
        imu: ImuSettings | None = None,
    ) -> None:
        self._drive = drive
        self.shake = shake
        self._encoders = encoders or EncoderSettings()
        self._imu = imu or ImuSettings()

    def begin(
        self, start: Pose, odometry: np.random.Generator, imu: np.random.Generator, shake: np.random.Generator
    ) -> None:
        """Begin an episode at a pose; each sensor has a source of noise of its own, so that none changes another's."""
        self._pose = start
        self._rolled_m = (0.0, 0.0)
        self._elapsed_s = 0.0
        self._odometer = Odometer(self._drive, self._encoders, odometry)
        self._unit = InertialUnit(self._imu, imu)
        self._shake = Shake(self.shake, self._drive, shake)
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
