"""Which modalities describe a frame, and how much each of them counts."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from smal.features import color, hog

# Raised whenever any descriptor changes its output, so that a model never meets features it was not learned on.
DESCRIPTOR_VERSION = 1

MODALITIES: Mapping[str, Callable[[NDArray[np.uint8]], NDArray[np.float32]]] = MappingProxyType(
    {"color": color.color_descriptor, "hog": hog.hog_descriptor}
)
SIZES: Mapping[str, int] = MappingProxyType({"color": color.SIZE, "hog": hog.SIZE})


@dataclass(frozen=True)
class FeatureSettings:
    """The modalities of a feature vector, in order.

    Parameters
    ----------
    modalities : tuple of str
        Names in `MODALITIES`, each at most once.
    weights : tuple of float
        Relative weight of each modality, finite and positive; only their ratios matter.

    Raises
    ------
    ValueError
        An unknown or repeated modality, or weights that do not fit.
    """

    modalities: tuple[str, ...] = ("color", "hog")
    weights: tuple[float, ...] = (1.0, 1.0)

    def __post_init__(self) -> None:
        unknown = [name for name in self.modalities if name not in MODALITIES]
        if unknown or not self.modalities:
            raise ValueError(f"unknown feature modality {unknown}; known are {sorted(MODALITIES)}")
        if len(set(self.modalities)) != len(self.modalities):
            raise ValueError(f"a feature modality is named twice in {self.modalities}")
        if len(self.weights) != len(self.modalities):
            raise ValueError(f"{len(self.modalities)} modalities need as many weights, got {len(self.weights)}")
        if not all(math.isfinite(weight) and weight > 0.0 for weight in self.weights):
            raise ValueError(f"modality weights must be finite and positive, got {self.weights}")

    @property
    def size(self) -> int:
        """Length m of a feature vector."""
        return sum(SIZES[name] for name in self.modalities)

    @property
    def slices(self) -> tuple[slice, ...]:
        """Where each modality lies in a feature vector."""
        ends = np.cumsum([SIZES[name] for name in self.modalities]).tolist()
        return tuple(slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def unit_weights(self) -> tuple[float, ...]:
        """The weights, scaled so that their squares sum to 1."""
        norm = math.sqrt(sum(weight * weight for weight in self.weights))
        return tuple(weight / norm for weight in self.weights)

    @property
    def fingerprint(self) -> str:
        """12 hex digits naming these raw features; weights are applied later and do not enter."""
        text = json.dumps([DESCRIPTOR_VERSION, [[name, SIZES[name]] for name in self.modalities]])
        return hashlib.sha256(text.encode()).hexdigest()[:12]
