"""How the robot moves between two frames: by its wheels' odometry, or by what each atom movement usually does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.settings import SETTINGS

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
    """How far the robot's movement differs from what it is said to be, standard deviations.

    `ahead` is of the way after a correlation length, as a share of it, `turn` of a turn after a radian; both grow with
    the square root. `pace` is of the logarithm of how much faster the robot is than said, which lasts for
    `SETTINGS.pace` correlation lengths.
    """

    ahead: float
    turn: float
    pace: float


BY_ODOMETRY = MotionNoise(*SETTINGS.wheels)
BY_ATOMS = MotionNoise(*SETTINGS.atoms)


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


def shows_same(
    poses: NDArray[np.float64], pose: NDArray[np.float64], length: float
) -> NDArray[np.bool_]:
    """Tell where a view is hardly another one than at a pose (3,): poses (f, 3), length that of correlation."""
    moved = poses - pose
    near = np.hypot(*moved[:, :2].T) < length / SETTINGS.views_a_length
    return np.asarray(near & (np.abs(wrapped(moved[:, 2])) < math.radians(SETTINGS.spacing_deg)))


def leads_on(
    poses: NDArray[np.float64], drives: NDArray[np.int32], length: float
) -> NDArray[np.bool_]:
    """Tell which frames a robot is to pass, (f,).

    Frames between two that show the same led nowhere: a wrong turn and its correction, or a way there and back. They
    are kept where the second of the two is further from the first than half of the way between: it leads on.
    """
    # However long it stands: the time to tell grows with the square of the frames that are compared.
    moved = np.append(True, np.diff(poses, axis=0).any(axis=1) | (np.diff(drives) != 0))
    poses = poses[moved]
    drives = drives[moved]
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    on = np.zeros(len(poses), dtype=np.bool_)
    frame = 0
    while frame < len(poses):
        on[frame] = True
        end = np.searchsorted(drives, drives[frame], "right")
        end = min(end, np.searchsorted(way, way[frame] + SETTINGS.mended * length, "right"))
        later = poses[frame + 1 : end]
        since = way[frame + 1 : end] - way[frame]
        apart = np.hypot(*(later - poses[frame])[:, :2].T)
        # Who turns on the spot creeps ahead a little.
        back = shows_same(later, poses[frame], length) & (
            apart < np.maximum(since, 0.1 * length) / 2.0
        )
        last = int(np.flatnonzero(back).max(initial=-1))
        frame += 1 if back[: last + 1].all() else last + 1
    return np.asarray(on[np.cumsum(moved) - 1])


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
