"""Boxes on flat ground, their depth images by ray casting, and a robot with exact motions."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.movement import Atom
from smal.obstacles.clearance import Mount

Box = tuple[float, float, float, float, float]  # x_min, y_min, x_max, y_max and height, metres.
MOUNT: Final = Mount(focal=0.65, height_m=1.0, ahead_m=0.35, radius_m=0.4, top_m=1.0)
SPEED_M_S: Final = 2.0
#: What each atom does in a tenth of a second.
MOVEMENTS: Final = np.array([(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.0785), (0.0, -0.0785)])


def depth(
    boxes: Sequence[Box],
    pose: Sequence[float],
    pitch_rad: float = 0.0,
    shape: tuple[int, int] = (60, 80),
) -> NDArray[np.float32]:
    """Return the depth image (height, width) of a pitched camera at a pose, 0 for the sky."""
    rows, columns = shape
    focal_px = MOUNT.focal * columns
    across = (columns / 2 - 0.5 - np.arange(columns)) / focal_px
    below = (np.arange(rows) + 0.5 - rows / 2)[:, None] / focal_px
    cos = math.cos(pitch_rad)
    sin = math.sin(pitch_rad)
    # Rays of one metre along the axis.
    ahead = cos - below * sin
    up = -sin - below * cos
    left = np.broadcast_to(across, (rows, columns))
    ahead, up = (np.broadcast_to(one, (rows, columns)) for one in (ahead, up))
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    origin = pose[0] + MOUNT.ahead_m * c, pose[1] + MOUNT.ahead_m * s, MOUNT.height_m
    rays = c * ahead - s * left, s * ahead + c * left, up
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(up < 0, -origin[2] / up, np.inf)
        for x_min, y_min, x_max, y_max, high in boxes:
            enters = np.zeros(shape)
            leaves = np.full(shape, np.inf)
            for low, top, start, ray in zip(
                (x_min, y_min, 0.0), (x_max, y_max, high), origin, rays, strict=True
            ):
                one = (low - start) / ray
                other = (top - start) / ray
                enters = np.maximum(enters, np.fmin(one, other))
                leaves = np.minimum(leaves, np.fmax(one, other))
            nearest = np.where(
                (enters < leaves) & (enters > 0), np.minimum(nearest, enters), nearest
            )
    return np.where(nearest < 30.0, nearest, 0.0).astype(np.float32)


def moved(
    pose: tuple[float, float, float], atom: Atom, share: float = 1.0
) -> tuple[float, float, float]:
    """Return where an atom leads."""
    ahead, turn = MOVEMENTS[atom] * share
    return pose[0] + ahead * math.cos(pose[2]), pose[1] + ahead * math.sin(pose[2]), pose[2] + turn


def touches(boxes: Sequence[Box], pose: Sequence[float]) -> bool:
    """Whether a robot at a pose touches a box."""
    away = (
        math.hypot(
            max(x_min - pose[0], 0.0, pose[0] - x_max), max(y_min - pose[1], 0.0, pose[1] - y_max)
        )
        for x_min, y_min, x_max, y_max, _ in boxes
    )
    return min(away, default=math.inf) < MOUNT.radius_m
