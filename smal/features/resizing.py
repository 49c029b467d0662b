"""Images of one size for every camera."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def resized(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """Bring an image (height, width) or (height, width, channels) of any size to some rows and columns."""
    import cv2  # noqa: PLC0415 - recognition reads the sizes of descriptors in an image without OpenCV

    shrinks = image.shape[0] >= rows and image.shape[1] >= columns
    # Area averaging is right for shrinking only; when enlarging it would repeat pixels and invent edges.
    return cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def resized_grey(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Bring an RGB image (height, width, 3) of any size to grey values (rows, columns)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(resized(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), rows, columns), dtype=np.uint8)
