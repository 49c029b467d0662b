"""Features that were made once, used with fewer modalities or in another order."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.features.settings import FeatureSettings


def select(raw: NDArray[Any], held: FeatureSettings, wanted: FeatureSettings) -> NDArray[Any]:
    """Take the wanted modalities, in their order, out of raw features (..., m) of those that are held.

    ValueError where the last axis is not m, or a modality is wanted that is not held.
    """
    if raw.ndim == 0 or raw.shape[-1] != held.size:
        raise ValueError(f"features must have {held.size} entries, got the shape {raw.shape}")
    missing = [name for name in wanted.modalities if name not in held.modalities]
    if missing:
        raise ValueError(f"the features {', '.join(held.modalities)} do not hold {', '.join(missing)}")
    if held.modalities == wanted.modalities:
        return raw
    where = dict(zip(held.modalities, held.slices, strict=True))
    return np.concatenate([raw[..., where[name]] for name in wanted.modalities], axis=-1)
