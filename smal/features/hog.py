"""Shape modality: histograms of oriented gradients (Dalal & Triggs 2005) on 240 x 320 grey values."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from smal.features.modality import unit_length
from smal.features.resizing import resized_grey

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
    return unit_length(np.asarray(_hog().compute(resized_grey(image, ROWS, COLUMNS))))
