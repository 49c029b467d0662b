"""Shape modality: histograms of oriented gradients (Dalal & Triggs 2005) on 240 x 320 grey values."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import cv2

ROWS, COLUMNS = 240, 320
CELL, BINS = 20, 9
BLOCK = 2 * CELL
SIZE = ((ROWS - BLOCK) // CELL + 1) * ((COLUMNS - BLOCK) // CELL + 1) * 4 * BINS


@cache
def _hog() -> "cv2.HOGDescriptor":
    import cv2  # noqa: PLC0415 - recognition reads SIZE in an image without OpenCV

    # OpenCV takes sizes as (width, height): window, block, block stride, cell.
    return cv2.HOGDescriptor((COLUMNS, ROWS), (BLOCK, BLOCK), (CELL, CELL), (CELL, CELL), BINS)


def hog_descriptor(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Describe an image by the directions of its edges.

    Parameters
    ----------
    image : uint8 array (height, width, 3)
        RGB, any size; brought to 240 rows and 320 columns of grey.

    Returns
    -------
    float32 array (5940,)
        11 x 15 overlapping blocks of 2 x 2 cells of 9 directions, unit length. An image without any
        edge (constant grey) has no direction and gives the zero vector.
    """
    import cv2  # noqa: PLC0415 - see above

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    shrinks = grey.shape[0] >= ROWS and grey.shape[1] >= COLUMNS
    # Area averaging is right for shrinking only; when enlarging it would repeat pixels and invent edges.
    small = cv2.resize(grey, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    vector = np.asarray(_hog().compute(small), dtype=np.float32).ravel()
    norm = float(np.linalg.norm(vector))
    return vector / np.float32(norm) if norm > 0.0 else vector
