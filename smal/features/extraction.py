"""From an image to a raw feature vector."""

import numpy as np
from numpy.typing import NDArray

from smal.features import color
from smal.features.settings import MODALITIES, FeatureSettings


def extract(image: NDArray[np.uint8], settings: FeatureSettings) -> NDArray[np.float32]:
    """Compute the raw features of one frame.

    Parameters
    ----------
    image : uint8 array (height, width, 3)
        RGB, at least 24 rows and 32 columns.
    settings : FeatureSettings

    Returns
    -------
    float32 array (m,)
        The modalities one after the other, each of unit length (or zero, see the modality); neither
        centred nor weighted, which `Centering.apply` does once the mean is known.

    Raises
    ------
    ValueError
        The image has another type, shape or is too small.
    """
    if image.dtype != np.uint8:
        raise ValueError(f"an image must be an array of uint8, got {image.dtype}")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"an image must have the shape (height, width, 3), got {image.shape}")
    if image.shape[0] < color.ROWS or image.shape[1] < color.COLUMNS:
        raise ValueError(
            f"an image must have at least {color.ROWS} rows and {color.COLUMNS} columns, "
            f"got {image.shape[0]} x {image.shape[1]}"
        )
    contiguous = np.ascontiguousarray(image)
    return np.concatenate([MODALITIES[name](contiguous) for name in settings.modalities])
