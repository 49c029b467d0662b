"""A corridor drawn with a few products, and a model of it that is learned in a second: for tests of the map of views.

What is seen changes with the robot's pose as in any room, so that the map, the filter and the planner work as they do
in a world of the simulator; a frame takes a millisecond.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.features import FeatureSettings
from smal.model import Model
from smal.movement import Atom, Motion
from smal.paper import learning
from smal.paper.model import PaperModel
from smal.teaching.from_arrays import demonstrations_of
from smal.teaching.mapping import fit

FEATURES: Final = FeatureSettings(("thumbnail",))
LENGTH: Final = 3
STEP_M: Final = 0.2  # Way from frame to frame, metres.
FRAMES: Final = 20
HEIGHT = 48
WIDTH = 64
#: Colours of left wall, right wall, floor and ceiling, half a metre a cell.
_PAINT: Final = np.random.default_rng(5).uniform(0, 255, (4, 60, 12, 3)).astype(np.float32)
Pose = tuple[float, float, float]


def view(
    x_m: float, y_m: float = 0.0, heading_rad: float = 0.0, scale: int = 1
) -> NDArray[np.uint8]:
    """Return what a camera half a metre above the floor sees, 2 m from both walls; x is along the corridor."""
    height = scale * HEIGHT
    width = scale * WIDTH
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    left, up = (
        (size / 2 - 0.5 - at) / (0.7 * width) for size, at in ((width, columns), (height, rows))
    )
    ray = np.array([math.cos(heading_rad) - math.sin(heading_rad) * left,
                    math.sin(heading_rad) + math.cos(heading_rad) * left, up])  # fmt: skip
    with np.errstate(divide="ignore"):
        reach = np.stack([(2 - y_m) / ray[1], (-2 - y_m) / ray[1], -0.5 / ray[2], 2 / ray[2]])
    reach[reach <= 0] = np.inf
    surface = reach.argmin(axis=0)
    reach = np.minimum(reach.min(axis=0), 30.0)
    x = x_m + reach * ray[0]
    y = y_m + reach * ray[1]
    z = reach * ray[2]
    along = (x + 3) * 2
    across = np.where(surface < 2, z + 0.5, y + 2) * 2
    a = np.clip(along, 0, 58.99)
    b = np.clip(across, 0, 10.99)
    i = a.astype(int)
    j = b.astype(int)
    f = (a - i)[..., None]
    g = (b - j)[..., None]
    near, far = (
        (1 - g) * _PAINT[surface, i + k, j] + g * _PAINT[surface, i + k, j + 1] for k in (0, 1)
    )
    fog = np.exp(-reach / 6)[..., None]
    return np.asarray(fog * ((1 - f) * near + f * far) + (1 - fog) * 128, dtype=np.uint8)


def pose(frame: int) -> Pose:
    """Return the taught pose of a frame; the way is straight along the middle."""
    return STEP_M * min(frame, FRAMES - 1), 0.0, 0.0


def moved(here: Pose, motion: Motion) -> Pose:
    """Return the pose after a frame of a motion: a step ahead and a turn of 4.5 degrees at most."""
    x_m, y_m, heading_rad = here
    heading_rad += math.radians(4.5) * motion[1]
    ahead_m = STEP_M * motion[0]
    return x_m + ahead_m * math.cos(heading_rad), y_m + ahead_m * math.sin(heading_rad), heading_rad


@cache
def model(odometry: bool = True) -> Model:
    """Learn one straight drive, with a map of views."""
    return fit([drive() if odometry else drive()[:2]], FEATURES)


@cache
def paper_model() -> PaperModel:
    """Learn the same drive by the paper's scheme."""
    return learning.learn(
        demonstrations_of([drive()], FEATURES), learning.LearningSettings(FEATURES, LENGTH)
    )


def drive() -> tuple[list[NDArray[np.uint8]], list[Atom], NDArray[np.float64]]:
    """Return images, atoms and odometry of the drive."""
    way = [pose(frame) for frame in range(FRAMES)]
    return [view(*one) for one in way], [Atom.FORWARD] * (FRAMES - 1) + [Atom.STOP], np.array(way)


def save_model(path: Path) -> Path:
    """Write `model`."""
    model().save(path)
    return path


def save_renewed(path: Path) -> Path:
    """Write `model` with a further look of a keyframe, as runs teach it: the keyframes are the same."""
    taught = model().mapped
    views = np.concatenate([taught.views, taught.views[5:6]])
    replace(
        model(), mapped=replace(taught, views=views, variants=np.array([5], dtype=np.int32))
    ).save(path)
    return path
