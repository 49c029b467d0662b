"""Images that only a simulator has, as messages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from schemas.depth_image import DepthImage
from schemas.overhead_image import Calibration, OverheadImage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from schemas.base import Message
    from services.simulator.world.place import OverheadMount

#: Largest depth image, pixels.
MOST_COLUMNS: Final = 320
MOST_ROWS: Final = 240
#: Farthest depth that is told; 16 bits of millimetres end there.
FARTHEST_M: Final = 65.0


def depth_message(header: Message, depth_m: NDArray[np.float32]) -> DepthImage:
    """Make the message of a depth image, of every n-th pixel so that it is small.

    Parameters
    ----------
    header
        Robot, episode, tick and stamp.
    depth_m
        (height, width) metres along the camera's axis, `inf` where nothing is.
    """
    height, width = depth_m.shape
    every = max(1, math.ceil(width / MOST_COLUMNS), math.ceil(height / MOST_ROWS))
    # From the middle of each block, so that a pixel of the small image looks where its block does.
    coarse = depth_m[every // 2 :: every, every // 2 :: every]
    near = np.where(coarse <= FARTHEST_M, coarse, 0.0)
    rows, columns = near.shape
    return DepthImage.after(header, width=columns, height=rows, data=np.rint(1000 * near).astype("<u2").tobytes())


def overhead_message(header: Message, image: NDArray[np.uint8], mount: OverheadMount) -> OverheadImage:
    """Make the message of the overhead camera's image, (height, width, 3), with how that camera sees."""
    height, width, _ = image.shape
    calibration = Calibration(
        focal_px=mount.focal_px,
        centre_x_px=width / 2,
        centre_y_px=height / 2,
        x_m=mount.x,
        y_m=mount.y,
        height_m=mount.height_m,
        up_rad=math.remainder(mount.up, math.tau),
    )
    return OverheadImage.after(header, width=width, height=height, data=image.tobytes(), calibration=calibration)
