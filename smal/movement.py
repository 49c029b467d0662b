"""How the robot moves between two frames: by its wheels' odometry, or by what each atom movement usually does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

#: What a robot is told: linear velocity, ahead, and angular velocity, to the left, as shares of its own, -1 to 1.
Motion = tuple[float, float]
STANDS: Final[Motion] = 0.0, 0.0


class Atom(IntEnum):
    """What the robot does between one camera frame and the next."""

    STOP = 0
    FORWARD = 1
    BACKWARD = 2
    LEFT = 3
    RIGHT = 4


@dataclass(frozen=True)
class Movement:
    """A small planar movement: the way along the heading, and the turn, counter-clockwise, in radians.

    The way is in metres, or in units of one forward atom where nothing tells metres; negative backwards.
    """

    ahead: float
    turn_rad: float

    @classmethod
    def between(cls, before: Sequence[float], after: Sequence[float]) -> "Movement":
        """Return the movement from one pose (x, y, heading in radians) to the next."""
        (x0, y0, heading) = before
        (x1, y1, new) = after
        ahead = (x1 - x0) * math.cos(heading) + (y1 - y0) * math.sin(heading)
        return cls(
            math.copysign(math.hypot(x1 - x0, y1 - y0), ahead),
            math.remainder(new - heading, math.tau),
        )


STILL = Movement(0.0, 0.0)


class MotionNoise(NamedTuple):
    """How far the robot's movement differs from the reported one: standard deviations."""

    #: Of the way after a correlation length, as a share of it; grows with the square root of the way.
    ahead: float
    turn: float  # Of a turn after a radian, radians; grows with the square root of the turn.
    pace: float  # Of the logarithm of the true speed over the reported one.
    pace_lengths: float = 10.0  # Way over which a pace lasts, correlation lengths.
    #: Degrees of heading a correlation length: carpets and kerbs; grows with the square root of the way.
    drift_deg: float = 1.5


#: Wheels slip a little, and those of two robots disagree by a twentieth.
BY_ODOMETRY: Final = MotionNoise(ahead=0.05, turn=0.03, pace=0.05)
#: Only the usual movement of an atom is known: people drive half as fast, or half as fast again.
BY_ATOMS: Final = MotionNoise(ahead=0.1, turn=0.1, pace=0.5)


def wrapped(angle_rad: NDArray[Any]) -> NDArray[Any]:
    """Bring angles into [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def seen_from(poses: NDArray[np.float64], frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (..., 3) as seen from others (..., 3): ahead, left, and turned left in [-pi, pi)."""
    x, y, turned = np.moveaxis(poses - frames, -1, 0)
    cos = np.cos(frames[..., 2])
    sin = np.sin(frames[..., 2])
    return np.stack([cos * x + sin * y, -sin * x + cos * y, wrapped(turned)], axis=-1)


def placed(offsets: NDArray[np.float64], frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (..., 3) that are seen so from others (..., 3), the opposite of `seen_from`; turns add up."""
    ahead, left, turned = np.moveaxis(offsets, -1, 0)
    x, y, heading = np.moveaxis(frames, -1, 0)
    cos = np.cos(heading)
    sin = np.sin(heading)
    return np.stack(
        [x + cos * ahead - sin * left, y + sin * ahead + cos * left, turned + heading], axis=-1
    )


def turns_ahead(movements: NDArray[np.float64]) -> bool:
    """Tell by `atom_movements` (5, 2) if the robot is a car: turning to either side it goes over half its way ahead."""
    ahead = np.abs(movements[:, 0])
    return bool(ahead[[Atom.LEFT, Atom.RIGHT]].min() > 0.5 * ahead[Atom.FORWARD])


def dead_reckoning(
    atoms: NDArray[np.integer[Any]], movements: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Add up what atoms (f,) usually do (`atom_movements`, (5, 2)): x, y and heading of every frame, (f, 3).

    From (0, 0, 0); a turn is made half before the way ahead and half after.
    """
    ahead, turn = movements[atoms[:-1]].T
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    middle = heading[:-1] + turn / 2.0
    x, y = (np.concatenate([[0.0], np.cumsum(ahead * part(middle))]) for part in (np.cos, np.sin))
    return np.stack([x, y, heading], axis=1)
