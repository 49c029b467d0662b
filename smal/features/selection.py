"""Features that were made once, used with fewer modalities or in another order."""

from functools import lru_cache
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.features.modalities import MODALITIES
from smal.features.settings import FeatureSettings, fingerprint_of


@lru_cache(maxsize=64)
def settings_of(fingerprint: str) -> FeatureSettings | None:
    """Return the settings, with equal weights, whose raw features a fingerprint names; None if it is of none.

    Features of a network's file are of none: a fingerprint does not tell where the file is.
    """
    # Every order of every subset, few modalities first: 1956 for six. Almost all that there are have two or three.
    orders = (order for count in range(1, len(MODALITIES) + 1) for order in permutations(MODALITIES.values(), count))
    found = (order for order in orders if fingerprint_of(order) == fingerprint)
    return next((FeatureSettings.of(modality.name for modality in order) for order in found), None)


def select(raw: NDArray[Any], held: FeatureSettings, wanted: FeatureSettings) -> NDArray[Any]:
    """Take the wanted modalities out of raw features.

    Parameters
    ----------
    raw : array (..., m)
        Raw features of the modalities `held`.
    held, wanted : FeatureSettings
        Their weights do not count.

    Returns
    -------
    array (..., m')
        Raw features of the modalities `wanted`, in their order.

    Raises
    ------
    ValueError
        The last axis is not m, or a modality is wanted that is not held.
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
