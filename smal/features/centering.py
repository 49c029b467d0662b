"""Centering: the common part of all frames carries no information about the place.

The paper matches uncentred descriptors. Their entries are all non-negative, so that any two frames have a
cosine of 0.88, and no threshold separates places; without the mean it is -0.03.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.features.settings import FeatureSettings

# A modality closer to the mean than this (unit-length vectors) is rounding noise: it has no direction.
_NOISE = 1e-6
_LARGEST = 1e6


class FeaturesError(ValueError):
    """Features of the wrong size, or not finite."""


@dataclass(frozen=True, eq=False)
class Centering:
    """Centres and normalises raw features: rows of the map, columns of X and Y in `smal.paper`."""

    #: (m,) mean raw feature vector of the demonstrations.
    mean: Float32s
    settings: FeatureSettings

    def __post_init__(self) -> None:
        if self.mean.shape != (self.settings.size,):
            raise ValueError(
                f"the mean must have the shape ({self.settings.size},), got {self.mean.shape}"
            )
        # Raw features are of unit length. Without this bound, the squares of a damaged file overflow.
        if self.mean.dtype.kind != "f" or not (np.abs(self.mean) <= _LARGEST).all():
            raise ValueError("the mean of the features is not finite, or too large")

    @classmethod
    def fit(cls, raw: AnyArray | Iterable[AnyArray], settings: FeatureSettings) -> Self:
        """Compute the mean of raw features (n, m), or of several such arrays, with at least one row in all."""
        total = np.zeros(settings.size)
        count = 0
        for part in [raw] if isinstance(raw, np.ndarray) else raw:
            if part.ndim != 2 or part.shape[1] != settings.size:
                raise ValueError(
                    f"the mean needs features (n, {settings.size}), got the shape {part.shape}"
                )
            total += part.sum(axis=0, dtype=np.float64)
            count += len(part)
        if count == 0:
            raise ValueError(f"the mean needs features (n, {settings.size}) with n >= 1, got none")
        return cls((total / count).astype(np.float32), settings)

    def apply(self, raw: AnyArray) -> Float32s:
        """Centre and normalise raw features (..., m) to norm 1, with equal weights of the modalities.

        A modality that is equal to its mean stays zero. FeaturesError if the last axis is not m, or a value is not
        finite.
        """
        if raw.ndim == 0 or raw.shape[-1] != self.settings.size:
            raise FeaturesError(
                f"features must have {self.settings.size} entries, got the shape {raw.shape}"
            )
        centred = np.asarray(raw - self.mean, dtype=np.float32)
        share = 1.0 / math.sqrt(len(self.settings.modalities))
        for where in self.settings.slices:
            norm = np.linalg.norm(centred[..., where], axis=-1, keepdims=True)
            if not np.isfinite(norm).all():
                raise FeaturesError("features contain NaN or infinity")
            scale = np.divide(share, norm, out=np.zeros_like(norm), where=norm > _NOISE)
            centred[..., where] *= scale
        return centred
