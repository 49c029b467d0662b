"""Shape modality: histograms of oriented gradients (Dalal & Triggs 2005) on 120 x 160 grey values.

The paper computes them on 240 x 320 values of the image itself. Every block is normalised, so that
in plain parts of a view (a wall, the sky) a block describes only the noise of the camera.
Therefore we smooth the image first. Under noise of 15 grey levels and with a third of the frames
hidden, a robot without smoothing looks around for ever. Without noise nothing is lost, because a
cell is a sixteenth of the width. Detail of 240 x 320 does not survive the smoothing, so that half
of the rows and columns describe the same in a quarter of the time.
"""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import PIXELS, resized_grey

if TYPE_CHECKING:
    import cv2

ROWS, COLUMNS = PIXELS
CELL = 10
BINS = 9
BLOCK = 2 * CELL
#: Standard deviation of the Gaussian against noise, pixels of the 120 x 160.
SMOOTHING_PX = 1.0
SIZE = ((ROWS - BLOCK) // CELL + 1) * ((COLUMNS - BLOCK) // CELL + 1) * 4 * BINS


@cache
def _hog() -> "cv2.HOGDescriptor":
    import cv2  # noqa: PLC0415 - containers that only need SIZE have no OpenCV

    # OpenCV takes sizes as (width, height): window, block, block stride, cell.
    return cv2.HOGDescriptor((COLUMNS, ROWS), (BLOCK, BLOCK), (CELL, CELL), (CELL, CELL), BINS)


def hog_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, resized to 120 rows and 160 columns of grey, by its edges, (5940,).

    11 x 15 overlapping blocks of 2 x 2 cells of 9 directions, unit length, after smoothing. A
    constant image gives the zero vector.
    """
    import cv2  # noqa: PLC0415 - see above

    smooth = cv2.GaussianBlur(resized_grey(image, ROWS, COLUMNS), (0, 0), SMOOTHING_PX)
    return unit_length(np.asarray(_hog().compute(smooth)))
