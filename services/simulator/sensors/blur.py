"""Motion blur: what a camera that turns collects while it is exposed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from services.simulator.sensors.shake import TiltRate

# Less than this moves no pixel visibly.
_LEAST_PX: Final = 0.25
# Pixels from one of the averaged pictures to the next: as the pictures are interpolated, no step shows.
_STEP_PX: Final = 1.5


def blur(image: NDArray[np.uint8], rate: TiltRate, exposure_s: float, focal_px: float) -> NDArray[np.uint8]:
    """Return the image as it is while the camera turns: the mean of its pictures along every pixel's path.

    Parameters
    ----------
    image
        (height, width, 3), as seen in the middle of the exposure.
    rate
        How the camera turns. To the left moves the picture to the right, downwards moves it up, and a roll turns it
        about its middle; for angles this small that is the same for everything in view, near or far.
    exposure_s
        How long, at least 0.
    focal_px
        Focal length, pixels.

    Returns
    -------
    (height, width, 3), with the edges continued outwards; the image itself where nothing moves visibly.
    """
    height, width = image.shape[:2]
    right_px = focal_px * rate.yaw_rad_s * exposure_s
    down_px = -focal_px * rate.pitch_rad_s * exposure_s
    turn_rad = rate.roll_rad_s * exposure_s
    longest_px = math.hypot(right_px, down_px) + abs(turn_rad) * math.hypot(width, height) / 2
    if longest_px < _LEAST_PX:
        return image
    count = math.ceil(longest_px / _STEP_PX) + 1
    total = np.zeros(image.shape, dtype=np.float32)
    for part in (np.arange(count) + 0.5) / count - 0.5:
        affine = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), math.degrees(part * turn_rad), 1.0)
        affine[:, 2] += part * right_px, part * down_px
        moved = cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
        cv2.accumulate(moved, total)
    return np.rint(total / count).astype(np.uint8)
