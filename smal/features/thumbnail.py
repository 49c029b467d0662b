"""Thumbnail modality: the small patch-normalized image of SeqSLAM (Milford & Wyeth 2012)."""

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import resized_grey

ROWS = 32
COLUMNS = 64
PATCH = 8
SIZE = ROWS * COLUMNS


def thumbnail_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, resized to 32 rows and 64 columns of grey, by normalised patches, (2048,).

    Row by row (I - mean) / deviation, with the mean and the standard deviation of the 8 x 8 patch around each pixel,
    scaled to unit length. A constant patch is zero; an image of constant patches gives the zero vector.
    """
    grey = resized_grey(image, ROWS, COLUMNS)
    patches = grey.reshape(ROWS // PATCH, PATCH, COLUMNS // PATCH, PATCH).astype(np.float32)
    # Exact for a constant patch: its sum is an integer, far below 2^24.
    centred = patches - patches.mean(axis=(1, 3), keepdims=True)
    deviation = np.sqrt(np.square(centred).mean(axis=(1, 3), keepdims=True))
    normalized = np.divide(centred, deviation, out=np.zeros_like(centred), where=deviation > 0.0)
    return unit_length(normalized)
