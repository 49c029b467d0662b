"""An inertial unit of a small robot: turn rates and accelerations with the noise of a MEMS sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from services.robot.body import ImuReading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from services.simulator.sensors.shake import Tilt, TiltRate
    from services.simulator.sensors.step import Step

GRAVITY_M_S2: Final = 9.81


@dataclass(frozen=True)
class ImuSettings:
    """Noise and range, gyroscope first, as calibration tools state them.

    The defaults are those of the ADIS16448 in the EuRoC data set (Burri and others, 2016), in the middle of what the
    sensors of small robots have; biases at switching on are after a short calibration at rest.

    Attributes
    ----------
    gyro_density, acceleration_density
        Density of the white noise: rad/s and m/s^2, each by the root of a hertz.
    gyro_walk, acceleration_walk
        Density of the white noise that the bias is the sum of: rad/s^2 and m/s^3, each by the root of a hertz.
    gyro_bias_rad_s, acceleration_bias_m_s2
        Standard deviation of each axis's bias at the start of an episode.
    gyro_range_rad_s, acceleration_range_m_s2
        Greatest reading: 2000 degrees a second and 16 g.
    """

    gyro_density: float = 1.6968e-4
    gyro_walk: float = 1.9393e-5
    gyro_bias_rad_s: float = 1e-3
    gyro_range_rad_s: float = math.radians(2000)
    acceleration_density: float = 2.0e-3
    acceleration_walk: float = 3.0e-3
    acceleration_bias_m_s2: float = 0.02
    acceleration_range_m_s2: float = 16 * GRAVITY_M_S2


class InertialUnit:
    """A gyroscope and an accelerometer over the middle of the wheels' axis, on what the camera shakes with.

    Parameters
    ----------
    settings
        Noise and range.
    rng
        Source of this episode's noise.
    """

    def __init__(self, settings: ImuSettings, rng: np.random.Generator) -> None:
        self._rng = rng
        self._density, self._walk, first, self._range = (
            np.repeat(pair, 3)
            for pair in (
                (settings.gyro_density, settings.acceleration_density),
                (settings.gyro_walk, settings.acceleration_walk),
                (settings.gyro_bias_rad_s, settings.acceleration_bias_m_s2),
                (settings.gyro_range_rad_s, settings.acceleration_range_m_s2),
            )
        )
        self._bias = first * rng.standard_normal(6)
        self._velocity_m_s = (0.0, 0.0)
        self._time_s = 0.0

    def step(self, step: Step, tilt: Tilt, rate: TiltRate) -> ImuReading:
        """Return the reading at the end of a step.

        Parameters
        ----------
        step
            The motion; the turn rate is the mean over it, the acceleration the mean from its middle back to the middle
            of the step before.
        tilt, rate
            How the unit is tilted against the level robot, a few degrees, and how fast that changes.
        """
        self._time_s += step.duration_s
        noise = self._density / math.sqrt(step.duration_s) * self._rng.standard_normal(6)
        self._bias += self._walk * math.sqrt(step.duration_s) * self._rng.standard_normal(6)
        true = np.concatenate([_angular_velocity(step, rate), self._acceleration(step, tilt)])
        read = np.clip(true + self._bias + noise, -self._range, self._range)
        gx, gy, gz, ax, ay, az = (float(value) for value in read)
        return ImuReading(self._time_s, (gx, gy, gz), (ax, ay, az))

    def _acceleration(self, step: Step, tilt: Tilt) -> NDArray[np.float64]:
        """Return what an accelerometer feels (3,), m/s^2: it is pushed by the ground as if it fell upwards."""
        velocity, before = step.velocity_m_s, self._velocity_m_s
        east, north = (
            (after - earlier) / step.duration_s for after, earlier in zip(velocity, before, strict=True)
        )  # fmt: skip
        self._velocity_m_s = velocity
        cos, sin = math.cos(step.before.heading), math.sin(step.before.heading)
        level = np.array([east * cos + north * sin, north * cos - east * sin, GRAVITY_M_S2])
        return np.asarray(tilt.matrix().T @ level, dtype=np.float64)


def _angular_velocity(step: Step, rate: TiltRate) -> NDArray[np.float64]:
    """Return the true turn rates (3,), rad/s; for a tilt of a few degrees the axes are those of the level robot."""
    return np.array([rate.roll_rad_s, rate.pitch_rad_s, rate.yaw_rad_s + step.turn_rate_rad_s])
