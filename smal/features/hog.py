"""Shape modality: histograms of oriented gradients (Dalal & Triggs 2005) on 240 x 320 grey values.

The paper computes them as they are. Every block is brought to one length, so that where a view is plain (a wall, the
sky) a camera's noise is all that a block shows; so we smooth before. Under noise of 15 grey levels and with a third of
the frames hidden, that is the difference between a robot that looks around for ever and one that drives on, and where
there is no noise nothing is lost: cells are 20 pixels wide.
"""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import resized_grey

if TYPE_CHECKING:
    import cv2

ROWS = 240
COLUMNS = 320
CELL = 20
BINS = 9
BLOCK = 2 * CELL
SMOOTHING_PX = (
    2.0  # Standard deviation of the Gaussian that takes the noise away, pixels of the 240 x 320.
)
SIZE = ((ROWS - BLOCK) // CELL + 1) * ((COLUMNS - BLOCK) // CELL + 1) * 4 * BINS


@cache
def _hog() -> "cv2.HOGDescriptor":
    import cv2  # noqa: PLC0415 - containers that only need SIZE have no OpenCV

    # OpenCV takes sizes as (width, height): window, block, block stride, cell.
    return cv2.HOGDescriptor((COLUMNS, ROWS), (BLOCK, BLOCK), (CELL, CELL), (CELL, CELL), BINS)


def hog_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, brought to 240 rows and 320 columns of grey and smoothed, by its edges, (5940,).

    11 x 15 overlapping blocks of 2 x 2 cells of 9 directions, unit length. An image without any edge (constant grey)
    has no direction and gives the zero vector.
    """
    import cv2  # noqa: PLC0415 - see above

    smooth = cv2.GaussianBlur(resized_grey(image, ROWS, COLUMNS), (0, 0), SMOOTHING_PX)
    return unit_length(np.asarray(_hog().compute(smooth)))
