"""Camera shake: the floor kicks the mast of a robot that drives, and the mast swings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from services.simulator.robots import Drive
    from services.simulator.sensors.step import Step

# Turning on the spot at the nominal rate shakes this much of what driving at the nominal speed does.
_TURNING: Final = 0.5
# The floor of a faster drive does not kick without limit.
_MOST: Final = 1.5


class Tilt(NamedTuple):
    """How a camera is turned against the level robot: about x (ahead), y (left), z (up), by the right hand.

    A positive roll lifts the left side, a positive pitch looks down, a positive yaw looks to the left.
    """

    roll_rad: float
    pitch_rad: float
    yaw_rad: float

    def matrix(self) -> NDArray[np.float64]:
        """Return the rotation (3, 3) that takes the camera's axes to the robot's: roll first, then pitch, then yaw."""
        (sr, sp, sy), (cr, cp, cy) = np.sin(self), np.cos(self)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


class TiltRate(NamedTuple):
    """How fast a tilt changes, rad/s."""

    roll_rad_s: float
    pitch_rad_s: float
    yaw_rad_s: float


LEVEL: Final = Tilt(0.0, 0.0, 0.0)
STILL: Final = TiltRate(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ShakeSettings:
    """How much the camera shakes.

    Attributes
    ----------
    strength
        Factor on the three amplitudes, at least 0; 0 is a camera that never shakes. 1 is a TurtleBot on a floor that
        is not quite even.
    roll_deg, pitch_deg, yaw_deg
        Standard deviation of each angle at the robot's nominal speed.
    correlation_s
        How long a swing lasts: the integral of the angles' autocorrelation over positive lags, greater than 0.
    exposure_s
        Time over which one picture collects light, at least 0; what moves meanwhile is blurred.
    """

    strength: float = 1.0
    roll_deg: float = 1.0
    pitch_deg: float = 1.0
    yaw_deg: float = 0.5
    correlation_s: float = 0.1
    exposure_s: float = 0.02


class Shake:
    """The tilt of a camera whose mast is a damped spring that the floor kicks while the robot moves.

    Each angle x is a critically damped oscillator, x'' + 2 k x' + k^2 x = noise, with k = 2 / `correlation_s`: the
    smoothest process of second order, so that it has a rate. The noise is as strong as the motion, so the robot's first
    metre builds the swinging up, and it dies away when the robot stands. It is stepped exactly, see `_propagation`.

    Parameters
    ----------
    settings
        How much.
    drive
        Whose nominal speeds count as full motion.
    rng
        Source of this episode's kicks.
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
        return Tilt(*(float(angle) for angle in self._amplitude * self._state[0]))

    @property
    def rate(self) -> TiltRate:
        """How fast it changes now."""
        return TiltRate(*(float(rate) for rate in self._amplitude * self._state[1]))

    def step(self, step: Step) -> None:
        """Let the time of one step pass."""
        swing, kick = _propagation(self._stiffness, step.duration_s)
        motion = _motion(step, self._drive)
        self._state = swing @ self._state + motion * (kick @ self._rng.standard_normal((2, 3)))


def _motion(step: Step, drive: Drive) -> float:
    """Return how much the robot moves: 0 where it stands, 1 at its nominal speed straight ahead."""
    speed = math.hypot(*step.velocity_m_s) / drive.speed_m_s
    turning = _TURNING * step.turn_rate_rad_s / drive.turn_rate_rad_s
    return min(math.hypot(speed, turning), _MOST)


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
