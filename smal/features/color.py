"""Colour modality: the image at a very low resolution (paper, section V: colour on 24 x 32)."""

from smal.arrays import Float32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import resized

ROWS = 24
COLUMNS = 32
SIZE = ROWS * COLUMNS * 3


def color_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image by its colours on a 24 x 32 grid, (2304,).

    RGB of every grid cell, row by row, scaled to unit length. An all-black image has no direction and gives the zero
    vector.
    """
    return unit_length(resized(image, ROWS, COLUMNS))
