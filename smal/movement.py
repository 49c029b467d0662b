"""Movement of the robot between two frames, by odometry or by the usual movement of each atom."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.arrays import AnyArray, Floats

#: Linear velocity ahead and angular velocity to the left, as shares of the robot's own, -1 to 1.
Motion = tuple[float, float]
STANDS: Final[Motion] = 0.0, 0.0
#: Concentration of the angles between headings and motion by which degrees fit better than radians.
_CLEARLY: Final = 0.2


class Atom(IntEnum):
    """A discrete motion between two camera frames."""

    STOP = 0
    FORWARD = 1
    BACKWARD = 2
    LEFT = 3
    RIGHT = 4


#: Full speed of each atom.
MOTIONS: Final[dict[Atom, Motion]] = {
    Atom.STOP: STANDS,
    Atom.FORWARD: (1.0, 0.0),
    Atom.BACKWARD: (-1.0, 0.0),
    Atom.LEFT: (0.0, 1.0),
    Atom.RIGHT: (0.0, -1.0),
}


@dataclass(frozen=True)
class Movement:
    """A small planar movement: the way along the heading, and the turn, counter-clockwise, in radians.

    The way is in metres, or in forward atoms without odometry; it is negative backwards.
    """

    ahead: float
    turn_rad: float

    @classmethod
    def between(cls, before: Sequence[float], after: Sequence[float]) -> "Movement":
        """Return the movement from one pose (x, y, heading in radians) to the next."""
        x0, y0, heading0 = before
        x1, y1, heading1 = after
        ahead = (x1 - x0) * math.cos(heading0) + (y1 - y0) * math.sin(heading0)
        distance = math.hypot(x1 - x0, y1 - y0)
        turn_rad = math.remainder(heading1 - heading0, math.tau)
        return cls(math.copysign(distance, ahead), turn_rad)


STILL = Movement(0.0, 0.0)


class MotionNoise(NamedTuple):
    """Standard deviations of the robot's movement from the reported movement."""

    #: Error of the way after a correlation length, as a share of it; grows with the square root of the way.
    ahead: float
    #: Error of a turn after a radian, radians; grows with the square root of the turn.
    turn: float
    #: Error of the logarithm of the true speed over the reported speed; turns scale with the speed.
    pace: float
    #: Way over which a pace lasts, correlation lengths.
    pace_lengths: float = 10.0
    #: Degrees of heading a correlation length (carpets, kerbs); grows with the square root of the way.
    drift_deg: float = 1.5
    #: Probability, for each new view, of a jump: the robot was carried (kidnapped), or its movement was far
    #: outside of these deviations. The view before makes a jump more likely, or less.
    jump: float = 5e-3


#: Wheels slip a little, and the odometry of two robots differs by a twentieth. A wheel keeps its size:
#: what a drive shows of the pace remains true on the whole drive.
BY_ODOMETRY: Final = MotionNoise(ahead=0.05, turn=0.03, pace=0.05, pace_lengths=100.0)
#: Only the usual movement of an atom is known. Another drive is half or twice as fast (one standard
#: deviation). Within a correlation length or a radian, the robot stops or moves twice as far (two
#: standard deviations). The usual movement misses a robot that is held, so jumps are more likely.
BY_ATOMS: Final = MotionNoise(ahead=0.5, turn=0.5, pace=math.log(2.0), jump=2e-2)


def is_pose(pose: Any) -> bool:  # noqa: ANN401 - given by a user
    """Return whether a value is three finite numbers: x, y and heading."""
    values = np.asarray(pose)
    return values.shape == (3,) and values.dtype.kind in "iuf" and bool(np.isfinite(values).all())


def in_degrees(poses: Floats) -> bool:
    """Return whether headings of poses (f, 3) beyond a turn fit the motion in degrees, not radians."""
    headings = poses[:-1, 2]
    x, y = np.diff(poses[:, :2], axis=0).T
    lengths = np.hypot(x, y)
    if np.abs(headings).max(initial=0.0) <= math.tau or not lengths.any():
        return False
    moved = np.arctan2(y, x)
    # Doubled angles are equal ahead and in reverse; their concentration ignores how a sensor is mounted.
    degrees, radians = (
        abs(np.average(np.exp(2j * (moved - headings * unit)), weights=lengths))
        for unit in (math.radians(1.0), 1.0)
    )
    return bool(degrees - radians > _CLEARLY)


def wrapped(angle_rad: AnyArray) -> AnyArray:
    """Wrap angles into [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def seen_from(poses: Floats, frames: Floats) -> Floats:
    """Return poses (..., 3) relative to frames (..., 3): ahead, left, and turned left in [-pi, pi)."""
    x, y, turned = np.moveaxis(poses - frames, -1, 0)
    cos = np.cos(frames[..., 2])
    sin = np.sin(frames[..., 2])
    ahead = cos * x + sin * y
    left = -sin * x + cos * y
    return np.stack([ahead, left, wrapped(turned)], axis=-1)


def placed(offsets: Floats, frames: Floats) -> Floats:
    """Return the poses (..., 3) at offsets from frames (..., 3), the inverse of `seen_from`; turns add up."""
    ahead, left, turned = np.moveaxis(offsets, -1, 0)
    x, y, heading = np.moveaxis(frames, -1, 0)
    cos = np.cos(heading)
    sin = np.sin(heading)
    placed_x = x + cos * ahead - sin * left
    placed_y = y + sin * ahead + cos * left
    return np.stack([placed_x, placed_y, turned + heading], axis=-1)


def turns_ahead(movements: Floats) -> bool:
    """Return whether the robot is a car, by `atom_movements` (5, 2): its turns go over half the way of FORWARD."""
    ahead = np.abs(movements[:, 0])
    turning = ahead[[Atom.LEFT, Atom.RIGHT]].min()
    return bool(turning > 0.5 * ahead[Atom.FORWARD])


def dead_reckoning(atoms: NDArray[np.integer[Any]], movements: Floats) -> Floats:
    """Integrate the usual movements of atoms (f,) into poses (f, 3): x, y and heading, from (0, 0, 0).

    Half of each turn precedes the way ahead. `movements` (5, 2) are `atom_movements`.
    """
    ahead, turn = movements[atoms[:-1]].T
    heading = np.append(0.0, np.cumsum(turn))
    middle = heading[:-1] + turn / 2.0
    x = np.append(0.0, np.cumsum(ahead * np.cos(middle)))
    y = np.append(0.0, np.cumsum(ahead * np.sin(middle)))
    return np.stack([x, y, heading], axis=1)
