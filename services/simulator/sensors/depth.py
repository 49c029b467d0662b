"""Model of a stereo depth camera with noise and holes, after the Intel RealSense D435.

The camera measures the disparity between two infrared imagers. Its error therefore grows with the
square of the distance, and points that only one imager sees have no depth.
"""

import math
import zlib
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

#: Largest depth image, pixels, and largest depth: 16 bits of millimetres end there.
_MOST_COLUMNS = 320
_MOST_ROWS = 240
_FARTHEST_M: Final = 65.0
#: Stereo baseline and minimum depth, metres.
_EYES_M = 0.05
_NEAREST_M = 0.28
#: Disparity error in an image 848 pixels wide: 1.2 % at 4 m (Intel specifies under 2 % at 2 m).
_SHIFT_PX = 0.08
_SHIFT_WIDTH_PX = 848
_PATCH_PX: Final = 4  # Size of the patches with correlated errors, pixels of the small image.
#: Probability of an invalid patch without texture at 0 m, and its increase for each metre.
_HOLES = 0.01
_HOLES_A_M = 0.005


def measured(depth_m: NDArray[np.float32], focal: float) -> NDArray[np.float32]:
    """Simulate the measurement of a true depth image.

    Parameters
    ----------
    depth_m : array of shape (height, width)
        True depth, metres.
    focal : float
        Focal length in image widths.

    Returns
    -------
    array of shape (rows, columns)
        Measured depth, metres, 0 where invalid. The same input gives the same output.
    """
    height, width = depth_m.shape
    every = max(1, math.ceil(width / _MOST_COLUMNS), math.ceil(height / _MOST_ROWS))
    # Sample the middle of each block, so that a small pixel has its block's viewing direction.
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
    noisy_m = true_m * (1.0 + share * true_m * error)
    lost = (hole < _HOLES + _HOLES_A_M * true_m) | _seen_by_one(true_m, focal * columns * _EYES_M)
    return np.where(lost | (true_m == 0.0) | (noisy_m > _FARTHEST_M), 0.0, noisy_m).astype(
        np.float32
    )


def _seen_by_one(true_m: NDArray[np.float32], shift_px_m: float) -> NDArray[np.bool_]:
    """Return the pixels that only one imager sees: outside the other's view, or occluded."""
    columns = np.arange(true_m.shape[1])
    matches = columns - np.where(true_m > 0.0, shift_px_m / np.maximum(true_m, _NEAREST_M), 0.0)
    # Columns in the other image; a point with a nearer neighbour at its column is occluded.
    nearest = np.minimum.accumulate(matches[:, ::-1], axis=1)[:, ::-1]
    hidden = np.append(nearest[:, 1:], np.full((len(matches), 1), np.inf), axis=1) <= matches
    return np.asarray((matches < 0.0) | hidden)
