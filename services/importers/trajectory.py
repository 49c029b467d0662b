"""Poses in space of a camera or body become the poses of a robot on the ground."""

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from services.importers.drive import Array, Tally

_LEAST_M: Final = 0.05  # Shorter movements are noise, and have no direction.
#: Concentration of the doubled angles between movement and orientation, from 0 to 1, above which
#: the orientation turns with the robot: 0.65 is a standard deviation of 26 degrees. Doubled angles
#: are equal ahead and in reverse.
_LEAST_ALIKE: Final = 0.65


def track_of(poses: Array, tally: Tally) -> Array:
    """Return poses on the ground (n, 4): time, x, y, heading.

    Poses (n, 8) have the columns time, x, y, z and the quaternion x, y, z, w. The vertical axis is
    z, or y of cameras, whichever varies less. Bodies and cameras are mounted in any direction: the
    robot's heading has a constant angle to its movement, which is mostly ahead. If the orientation
    does not turn with the movement, the heading is the direction of the movement.
    """
    sound = np.isfinite(poses).all(axis=1)
    tally.count("poses are not numbers", int((~sound).sum()))
    poses = poses[sound][np.argsort(poses[sound, 0], kind="stable")]
    if not len(poses):
        return np.zeros((0, 4))
    extent = np.ptp(poses[:, 1:4], axis=0)
    ground = np.eye(3)[[0, 1]] if extent[2] <= extent[1] else np.array([[0, 0, 1.0], [-1.0, 0, 0]])
    places = poses[:, 1:4] @ ground.T
    heading = _heading(ground, poses[:, 4:8])
    rows = _apart(places)
    directions = np.arctan2(*np.diff(places[rows], axis=0).T[::-1])
    beside = np.exp(1j * (directions - heading[rows[1:]])) if directions.size else np.ones(1)
    doubled = (beside**2).mean()
    if abs(doubled) >= _LEAST_ALIKE:
        mount = np.exp(1j * np.angle(doubled) / 2.0)
        ahead = (beside / mount).real.mean() >= 0.0
        heading = heading + np.angle(mount if ahead else -mount)
    else:
        tally.say("orientations do not turn with the robot: headings are those of its movement")
        heading = np.interp(np.arange(len(poses)), rows[1:], np.unwrap(directions))
    return np.column_stack([poses[:, 0], places, heading])


def _apart(places: Array) -> list[int]:
    """Return rows of places from which each is far enough from the one before."""
    rows = [0]
    for row, place in enumerate(places):
        if np.hypot(*(place - places[rows[-1]])) >= _LEAST_M:
            rows.append(row)
    return rows


def _heading(ground: Array, quaternions: Array) -> Array:
    """Return the heading of the axis of the body that stays closest to the ground."""
    given = np.linalg.norm(quaternions, axis=1, keepdims=True) > 0.0
    turns = Rotation.from_quat(np.where(given, quaternions, (0.0, 0.0, 0.0, 1.0))).as_matrix()
    axes = np.einsum("gi,nij->njg", ground, turns)  # Each axis of the body on the ground.
    flattest = np.linalg.norm(axes, axis=2).min(axis=0).argmax()
    return np.asarray(np.arctan2(axes[:, flattest, 1], axes[:, flattest, 0]))
