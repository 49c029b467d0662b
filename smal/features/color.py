"""Colour modality: the image itself, seen from very far away (paper, section IV: colour on 24 x 32)."""

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 24, 32
SIZE = ROWS * COLUMNS * 3


def color_descriptor(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Describe an image by its colours on a 24 x 32 grid.

    Parameters
    ----------
    image : uint8 array (height, width, 3)
        RGB, at least 24 rows and 32 columns.

    Returns
    -------
    float32 array (2304,)
        RGB of every grid cell, row by row, scaled to unit length. An all-black image has no direction
        and gives the zero vector.
    """
    import cv2  # noqa: PLC0415 - recognition reads SIZE in an image without OpenCV

    small = cv2.resize(image, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    vector = small.astype(np.float32).ravel()
    norm = float(np.linalg.norm(vector))
    return vector / np.float32(norm) if norm > 0.0 else vector
