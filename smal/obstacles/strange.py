"""Without a depth camera: ground ahead that looks like none that was seen there when the way was taught.

Each keyframe keeps which colours the ground before it has. A patch of the ground that the robot is about to sweep is
strange as far as its colours are away from all that keyframes about it have: so it need not be laid over a taught
picture to the pixel, and a mark on the road that is seen from aside is none. How strange the taught views themselves
are, each left out of what explains it, says from where on a patch is none of them: an exponential tail.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from smal.arrays import Float32s, Floats, Indices, Uint8s
from smal.camera import Camera, Image
from smal.features.resizing import SHAPE
from smal.sought.sight import cells_of

_HORIZON: Final = SHAPE[0] // 2 + 3  # Row from which on there is ground; what is higher is too far.
_STEP: Final = 2  # Rows and columns from one cell to the next; a patch is three cells wide.
_KEPT: Final = 3  # And of the cells that a keyframe keeps.
LOOKS_S: Final = 3.0  # Time of driving, seconds, within which the ground ahead is looked at.
_FINE: Final = 200.0  # Values of a byte for a colour of 1; the brightest is 1.22.


@dataclass(frozen=True)
class GroundConfig:
    """Numbers by which ground is unexpected."""

    #: Half the width of what a robot sweeps, in heights of its camera: robots are about as wide as that is high.
    swept: float = 0.7
    lasts_s: float = 0.2  # For so long, at least, it must be seen.
    keyframes: int = 3  # To either side whose ground is known here.
    views: float = (
        1e4  # One of so many views is mistaken for unexpected: a kilometre of keyframes indoors.
    )
    #: Colours that are less apart are alike: a twelfth of the brightness, by light, exposure and compression.
    least: float = 0.03
    patch_known: int = 6  # Of the nine cells of a patch that must lie on the swept ground.


GROUND_CONFIG: Final = GroundConfig()


@dataclass(frozen=True, eq=False)
class Ground:
    """How the ground before each keyframe looks; a level camera over it, its height in the map's unit."""

    colours: Uint8s  # (k, n, 3) of some cells of each keyframe.
    strange: float  # A patch whose colours are further from all of theirs is strange.

    def __post_init__(self) -> None:
        """ValueError where parts do not fit together: they may come from a file."""
        shaped = (
            self.colours.dtype == np.uint8 and self.colours.ndim == 3 and self.colours.shape[2] == 3
        )
        if not (shaped and self.colours.shape[1] > 0 and 0.0 < self.strange < 10.0):
            raise ValueError("the parts of what the ground looks like do not fit together")

    def strange_m(self, picture: Image, keyframes: Indices, way: Floats, scene: Floats) -> float:
        """Return how far along a way (s, 2), ahead and left of it, a robot sees strange ground first, or infinity.

        `keyframes` are those about it, `scene` is a map's.
        """
        along, score = patches(picture, self.colours[keyframes], way, scene)
        return float(along[score > self.strange].min(initial=math.inf))


def swept(speed: float) -> Floats:
    """Return how far along its way a robot of this speed looks at the ground that it sweeps, (s,): every 0.1 s."""
    return np.linspace(0.0, LOOKS_S * speed, 32)


def colours_of(picture: Image) -> Uint8s:
    """Return the colours of the ground in a small picture, (n, 3)."""
    seen = _mean_colours(picture, _KEPT)[-(-_HORIZON // _KEPT) :].reshape(-1, 3)
    return np.asarray(np.rint(_FINE * seen), dtype=np.uint8)


def patches(
    picture: Image,
    colours: Uint8s,
    way: Floats,
    scene: Floats,
    config: GroundConfig = GROUND_CONFIG,
) -> tuple[Floats, Floats]:
    """Return of each patch of the swept ground how far along the way it is, and how unlike all colours."""
    ahead, left = _ground(float(scene[0]), float(scene[1]))
    reach = np.hypot(*way.T).max(initial=0.0)
    near = np.flatnonzero((ahead < reach) & (np.abs(left) < reach))
    apart = np.hypot(ahead.ravel()[near, None] - way[:, 0], left.ravel()[near, None] - way[:, 1])
    near = near[apart.min(axis=1, initial=math.inf) < config.swept * scene[1]]
    at = ahead.ravel()
    if not near.size:
        return np.empty(0), np.empty(0)
    seen = _mean_colours(picture, _STEP).reshape(-1, 3)[near]
    known = colours.reshape(-1, 3) / np.float32(_FINE)
    squares = (known * known).sum(axis=1) - 2.0 * seen @ known.T
    away = np.sqrt(np.maximum(squares.min(axis=1) + (seen * seen).sum(axis=1), 0.0))
    sums = np.zeros(ahead.shape)
    count = np.zeros(ahead.shape)
    sums.flat[near] = away
    count.flat[near] = 1.0
    sums = _in_patches(sums)
    count = _in_patches(count)
    whole = np.flatnonzero(count >= config.patch_known)
    return at[whole], sums.flat[whole] / count.flat[whole]


def extreme(scores: Sequence[float], config: GroundConfig = GROUND_CONFIG) -> float:
    """Return what one of `GroundConfig.views` exceeds, by an exponential tail of the highest tenth of scores."""
    usual = float(np.quantile(scores, 0.9))
    beyond = [score - usual for score in scores if score > usual]
    return usual + float(np.mean(beyond or [usual])) * math.log(0.1 * config.views)


def _mean_colours(picture: Image, step: int) -> Float32s:
    """Return the mean colour of every `step`-th cell and its eight neighbours, as if it were as bright as any."""
    cells = cells_of(picture, step)
    mean: Float32s = cells.reshape(*cells.shape[:2], -1, 3).mean(axis=2)
    return mean


def _ground(field_deg: float, height: float) -> tuple[Floats, Floats]:
    """Return where the ground is that cells of a picture show: ahead and left of the camera; infinity above it."""
    focal = Camera.of_field(field_deg).focal * SHAPE[1]
    rows, columns = np.mgrid[0 : SHAPE[0] : _STEP, 0 : SHAPE[1] : _STEP]
    down = rows - (SHAPE[0] - 1) / 2.0
    ahead = np.where(rows >= _HORIZON, focal * height / np.maximum(down, 1.0), math.inf)
    return ahead, np.where(
        np.isfinite(ahead), ((SHAPE[1] - 1) / 2.0 - columns) * height / np.maximum(down, 1.0), 0.0
    )


def _in_patches(cells: Floats) -> Floats:
    """Return the sum over each cell and its eight neighbours."""
    edged = np.pad(cells, 1)
    rows, columns = cells.shape
    return np.asarray(sum(edged[y : y + rows, x : x + columns] for y in range(3) for x in range(3)))
