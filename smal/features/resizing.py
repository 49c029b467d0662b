"""Images of one size for every camera."""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Uint8s

SHAPE: Final = (
    60,
    80,
)  # Rows and columns of `small`: a person who lies 5 m away takes 20 of the columns.


def resized(image: AnyArray, rows: int, columns: int) -> AnyArray:
    """Bring an image (height, width) or (height, width, channels) of any size to some rows and columns."""
    import cv2  # noqa: PLC0415 - recognition reads the sizes of descriptors in an image without OpenCV

    shrinks = image.shape[0] >= rows and image.shape[1] >= columns
    # Area averaging is right for shrinking only; when enlarging it would repeat pixels and invent edges.
    return cv2.resize(
        image, (columns, rows), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )


def resized_grey(image: Uint8s, rows: int, columns: int) -> Uint8s:
    """Bring an RGB image (height, width, 3) of any size to grey values (rows, columns)."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(
        resized(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), rows, columns), dtype=np.uint8
    )


def small(image: AnyArray) -> Uint8s:
    """Return the picture (60, 80, 3) of an RGB image in which a robot looks for what it was sent to find."""
    import cv2  # noqa: PLC0415 - see above

    return np.asarray(cv2.resize(image, SHAPE[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)
