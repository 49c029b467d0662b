"""The small picture of a frame in which a robot looks for what it was sent to find (`smal.sought.sight`)."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

SHAPE: Final = (60, 80)  # Its rows and columns: a person who lies 5 m away takes 20 of the columns.


def small(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the picture (60, 80, 3) of a camera image (height, width, 3), both uint8 RGB."""
    import cv2  # noqa: PLC0415 - processes that only read models have no OpenCV

    return np.asarray(cv2.resize(image, SHAPE[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)
