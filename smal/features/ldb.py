"""LDB modality: local difference binary (Yang & Cheng 2012) of the whole image, as ABLE uses it (Arroyo et al. 2014).

Three comparisons of two parts of the view (which is brighter, which darkens more to the right, and which downwards)
survive most changes of exposure and light; the differences themselves do not. Therefore the descriptor contains signs
only. The cosine of two descriptors without ties is 1 - 2 h / n, with their Hamming distance h and their number of bits
n. So matching by cosine is the papers' matching by Hamming distance.
"""

from functools import cache

import numpy as np

from smal.arrays import Float32s, Indices, Int8s, Int32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import resized_grey

# Cells, and halves of cells, of every grid have whole pixels.
SIDE = 120
GRIDS = (2, 3, 4, 5)
_PAIRS = sum(grid**2 * (grid**2 - 1) // 2 for grid in GRIDS)
SIZE = 3 * _PAIRS


def ldb_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, resized to 120 x 120 grey values, by comparing its parts, (1386,).

    For each grid (2 x 2, 3 x 3, 4 x 4, 5 x 5) and each of intensity, dx and dy: for all pairs of cells, first < second
    in reading order, the sign of first - second, all scaled to unit length. A tie is 0, and not one of two bits as in
    the papers: a cloudless sky gives no information instead of noise. A constant image gives the zero vector.
    """
    import cv2  # noqa: PLC0415 - containers that only need SIZE have no OpenCV

    integral = np.asarray(cv2.integral(resized_grey(image, SIDE, SIDE)), dtype=np.int32)
    signs = [_signs(cell_sums(integral, grid)) for grid in GRIDS]
    return unit_length(np.concatenate(signs))


def cell_sums(integral: Int32s, grid: int) -> Int32s:
    """Return intensity, dx and dy of all cells of a grid (3, grid * grid), in integers, so that ties are exact.

    Intensity is the sum over the cell, dx its right half less its left half, dy its lower half less its upper half. All
    cells of a grid have one size, so that sums compare like means. `integral` (121, 121) is the integral image;
    2 * grid divides 120.
    """
    step = SIDE // (2 * grid)
    corners = integral[::step, ::step]
    quarters = corners[1:, 1:] - corners[:-1, 1:] - corners[1:, :-1] + corners[:-1, :-1]
    upper_left = quarters[::2, ::2]
    upper_right = quarters[::2, 1::2]
    lower_left = quarters[1::2, ::2]
    lower_right = quarters[1::2, 1::2]
    left = upper_left + lower_left
    right = upper_right + lower_right
    upper = upper_left + upper_right
    lower = lower_left + lower_right
    return np.stack([left + right, right - left, lower - upper]).reshape(3, -1)


def _signs(sums: Int32s) -> Int8s:
    first, second = _pairs(sums.shape[1])
    return np.asarray(np.sign(sums[:, first] - sums[:, second]), dtype=np.int8).ravel()


@cache
def _pairs(cells: int) -> tuple[Indices, Indices]:
    first, second = np.triu_indices(cells, k=1)
    return first, second
