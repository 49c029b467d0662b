"""Small images, for the methods that work on images and not on features."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 48, 64


def thumbnail(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Shrink an RGB image (height, width, 3) to (48, 64, 3), each pixel the mean of the area that it covers."""
    import cv2  # noqa: PLC0415 - see smal.features.hog

    small: NDArray[np.uint8] = cv2.resize(np.ascontiguousarray(image), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return small
