"""Unexpected ground: ground ahead unlike the taught ground, detected without a depth camera.

Each keyframe stores the colours of the ground before it. A patch of the ground ahead is unexpected if its colours are
far from all colours of the neighbouring keyframes. So the patch need not be aligned with a taught picture to the pixel,
and a mark on the road seen from aside is expected. The threshold comes from the taught views themselves, each compared
with its neighbours without itself, with an exponential tail.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from smal.arrays import Float32s, Floats, Indices, Uint8s
from smal.camera import Image, Scene
from smal.features.cells import cells_of
from smal.features.resizing import SHAPE
from smal.map import VisualMap

#: First row with ground; higher rows are too far away.
_HORIZON: Final = SHAPE[0] // 2 + 3
#: Rows and columns from one cell to the next; a patch is three cells wide.
_STEP: Final = 2
#: The same for the cells that a keyframe stores.
_KEPT: Final = 3
#: Time of driving, seconds, within which the ground ahead is inspected.
INSPECTS_S: Final = 3.0
#: Byte values of a colour of 1; the brightest is 1.22.
_FINE: Final = 200.0


@dataclass(frozen=True)
class GroundConfig:
    """Parameters of the detection of unexpected ground."""

    #: Half the width of the swept ground, in heights of the camera: robots are about as wide as their camera is high.
    swept: float = 0.7
    #: Minimum duration of a detection.
    lasts_s: float = 0.2
    #: Keyframes to either side whose ground counts as taught here.
    keyframes: int = 3
    #: Views per false detection: a kilometre of keyframes indoors.
    views: float = 1e4
    #: Colours that are less apart are alike: a twelfth of the brightness, by light, exposure and compression.
    least: float = 0.03
    #: Minimum number of the nine cells of a patch on the swept ground.
    patch_known: int = 6


GROUND_CONFIG: Final = GroundConfig()


@dataclass(frozen=True, eq=False)
class Ground:
    """Colours of the ground before each keyframe."""

    #: (k, n, 3) of some cells of each keyframe.
    colours: Uint8s
    #: Distance of colours from which a patch is unexpected.
    threshold: float

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together: they can come from a file."""
        colours = self.colours
        shaped = colours.dtype == np.uint8 and colours.ndim == 3 and colours.shape[2] == 3
        if not (shaped and colours.shape[1] > 0 and 0.0 < self.threshold < 10.0):
            raise ValueError("the parts of the ground do not fit together")

    def unexpected(
        self, picture: Image, keyframes: Indices, way: Floats, mapped: VisualMap
    ) -> float:
        """Return the distance to the first unexpected ground along a way (s, 2), or infinity.

        Parameters
        ----------
        picture : array (60, 80, 3)
        keyframes : array
            Keyframes around the robot.
        way : array (s, 2)
            Places ahead and left of the robot.
        mapped : VisualMap
        """
        along, score = patches(picture, self.colours[keyframes], way, mapped)
        return float(along[score > self.threshold].min(initial=math.inf))


def swept(speed: float) -> Floats:
    """Return the distances along the way at which a robot of this speed inspects the ground, (s,): every 0.1 s."""
    return np.linspace(0.0, INSPECTS_S * speed, 32)


def colours_of(picture: Image) -> Uint8s:
    """Return the colours of the ground in a small picture, (n, 3)."""
    ground = _mean_colours(picture, _KEPT)[-(-_HORIZON // _KEPT) :]
    return np.asarray(np.rint(_FINE * ground.reshape(-1, 3)), dtype=np.uint8)


def patches(
    picture: Image,
    colours: Uint8s,
    way: Floats,
    mapped: VisualMap,
) -> tuple[Floats, Floats]:
    """Return for each patch of the swept ground its distance along the way, and its distance from all colours."""
    width, height = mapped.size
    ahead, left = _ground(mapped.taught_scene, height / width)
    near = _swept_cells(ahead, left, way, GROUND_CONFIG.swept * mapped.taught_scene.height)
    if not near.size:
        return np.empty(0), np.empty(0)
    cells = _mean_colours(picture, _STEP).reshape(-1, 3)[near]
    known = colours.reshape(-1, 3) / np.float32(_FINE)
    squares = (known * known).sum(axis=1) - 2.0 * cells @ known.T
    nearest = squares.min(axis=1) + (cells * cells).sum(axis=1)
    sums = np.zeros(ahead.shape)
    count = np.zeros(ahead.shape)
    sums.flat[near] = np.sqrt(np.maximum(nearest, 0.0))
    count.flat[near] = 1.0
    sums = _in_patches(sums)
    count = _in_patches(count)
    whole = np.flatnonzero(count >= GROUND_CONFIG.patch_known)
    return ahead.ravel()[whole], sums.flat[whole] / count.flat[whole]


def _swept_cells(ahead: Floats, left: Floats, way: Floats, half_width: float) -> Indices:
    """Return the indices of the cells within half the width of a way (s, 2)."""
    reach = np.hypot(*way.T).max(initial=0.0)
    near = np.flatnonzero((ahead < reach) & (np.abs(left) < reach))
    along = ahead.ravel()[near, None] - way[:, 0]
    aside = left.ravel()[near, None] - way[:, 1]
    apart = np.hypot(along, aside)
    inside = apart.min(axis=1, initial=math.inf) < half_width
    return np.asarray(near[inside])


def extreme(scores: Sequence[float]) -> float:
    """Return the threshold that one of `GroundConfig.views` exceeds, by an exponential tail of the highest tenth."""
    usual = float(np.quantile(scores, 0.9))
    beyond = [score - usual for score in scores if score > usual]
    mean = float(np.mean(beyond or [usual]))
    return usual + mean * math.log(0.1 * GROUND_CONFIG.views)


def _mean_colours(picture: Image, step: int) -> Float32s:
    """Return the mean colour of every `step`-th cell and its eight neighbours, normalised in brightness."""
    cells = cells_of(picture, step)
    mean: Float32s = cells.reshape(*cells.shape[:2], -1, 3).mean(axis=2)
    return mean


@lru_cache(maxsize=2)
def _ground(scene: Scene, aspect: float) -> tuple[Floats, Floats]:
    """Return the ground in each cell of a small picture: ahead and left of the camera.

    Above the horizon, and behind the camera, it is infinitely far ahead.
    """
    cells = (slice(None, None, _STEP), slice(None, None, _STEP))
    right, down, ahead = (part[cells] for part in scene.camera.rays(SHAPE, aspect))
    rows = np.arange(0, SHAPE[0], _STEP)[:, None]
    on_ground = (rows >= _HORIZON) & (down > 0.0) & (ahead > 0.0)
    reach = np.divide(scene.height, down, where=on_ground, out=np.zeros_like(down))
    return np.where(on_ground, reach * ahead, math.inf), -reach * right


def _in_patches(cells: Floats) -> Floats:
    """Return the sum over each cell and its eight neighbours."""
    edged = np.pad(cells, 1)
    rows, columns = cells.shape
    return np.asarray(sum(edged[y : y + rows, x : x + columns] for y in range(3) for x in range(3)))
