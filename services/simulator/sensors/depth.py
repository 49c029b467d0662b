"""The robot's depth camera: a pair of infrared eyes, with the noise and the holes that such a pair has.

After the Intel RealSense D435, the usual one on small robots: it measures how far a speck is shifted from one eye to
the other, so that its error grows with the square of the distance, and tells nothing of what one eye does not see.
"""

import math
import zlib
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

#: Largest depth image, pixels, and the farthest depth that is told: 16 bits of millimetres end there.
_MOST_COLUMNS = 320
_MOST_ROWS = 240
_FARTHEST_M: Final = 65.0
#: Between its eyes, and what is too near for both, metres.
_EYES_M = 0.05
_NEAREST_M = 0.28
#: Error of a shift, of an image 848 pixels wide, pixels: 1.2 % at 4 m, as Intel tells of it less than 2 % at 2 m.
_SHIFT_PX = 0.08
_SHIFT_WIDTH_PX = 848
_PATCH_PX: Final = 4  # Neighbours err alike, over so many pixels of the small image.
#: Share of patches without texture that tell nothing near by, and how much more a metre further on.
_HOLES = 0.01
_HOLES_A_M = 0.005


def measured(depth_m: NDArray[np.float32], focal: float) -> NDArray[np.float32]:
    """Return what is measured of a true depth image (height, width), metres, as a small image; 0 where nothing is.

    `focal` is the focal length over the width. The same image is measured the same way.
    """
    height, width = depth_m.shape
    every = max(1, math.ceil(width / _MOST_COLUMNS), math.ceil(height / _MOST_ROWS))
    # From the middle of each block, so that a pixel of the small image looks where its block does.
    true_m = depth_m[every // 2 :: every, every // 2 :: every]
    true_m = np.where((true_m <= _FARTHEST_M) & (true_m >= _NEAREST_M), true_m, np.float32(0.0))
    rows, columns = true_m.shape
    rng = np.random.default_rng(zlib.crc32(true_m.tobytes()))
    patches = math.ceil(rows / _PATCH_PX) + 1, math.ceil(columns / _PATCH_PX) + 1
    error, hole = (
        cv2.resize(one.astype(np.float32), (columns, rows), interpolation=how)
        for one, how in (
            (rng.standard_normal(patches), cv2.INTER_LINEAR),
            (rng.uniform(size=patches), cv2.INTER_NEAREST),
        )
    )
    share = _SHIFT_PX / (_SHIFT_WIDTH_PX * focal * _EYES_M)
    told_m = true_m * (1.0 + share * true_m * error)
    lost = (hole < _HOLES + _HOLES_A_M * true_m) | _seen_by_one(true_m, focal * columns * _EYES_M)
    return np.where(lost | (true_m == 0.0) | (told_m > _FARTHEST_M), 0.0, told_m).astype(np.float32)


def _seen_by_one(true_m: NDArray[np.float32], shift_px_m: float) -> NDArray[np.bool_]:
    """Tell which pixels only one eye sees: the other one's view ends, or something nearer hides them from it."""
    columns = np.arange(true_m.shape[1])
    there = columns - np.where(true_m > 0.0, shift_px_m / np.maximum(true_m, _NEAREST_M), 0.0)
    # Where they are in the other eye's picture, from left to right, but what hides them is there already.
    nearest = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    hidden = np.append(nearest[:, 1:], np.full((len(there), 1), np.inf), axis=1) <= there
    return np.asarray((there < 0.0) | hidden)
