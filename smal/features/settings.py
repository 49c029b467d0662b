"""Which modalities describe a frame, and how much each of them counts."""

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from smal.features import onnx
from smal.features.modalities import modality_named
from smal.features.modality import Input

# Raised whenever any descriptor changes its output, so that a model never meets features it was not learned on.
DESCRIPTOR_VERSION = 2


@dataclass(frozen=True)
class FeatureSettings:
    """The modalities of a feature vector, in order, each at most once, and their relative weights, above 0.

    Weights are finite; only their ratios matter. ValueError where a modality is unknown or repeated, or weights do not
    fit.
    """

    modalities: tuple[str, ...] = ("color", "hog")
    weights: tuple[float, ...] = (1.0, 1.0)

    def __post_init__(self) -> None:
        if not self.modalities:
            raise ValueError("no feature modality is named")
        for name in self.modalities:
            modality_named(name)
        twice = [name for name in self.modalities if self.modalities.count(name) > 1]
        if twice:
            raise ValueError(f"the feature modality {twice[0]} is named twice")
        if len(self.weights) != len(self.modalities):
            raise ValueError(f"{len(self.modalities)} modalities need as many weights, got {len(self.weights)}")
        if not all(math.isfinite(weight) and weight > 0.0 for weight in self.weights):
            raise ValueError(f"modality weights must be finite and positive, got {', '.join(map(str, self.weights))}")

    @classmethod
    def of(cls, modalities: Iterable[str], weights: Iterable[float] | None = None) -> Self:
        """Make the settings of some modalities, equal in weight unless weights are given."""
        names = tuple(modalities)
        return cls(names, (1.0,) * len(names) if weights is None else tuple(weights))

    @classmethod
    def parse(cls, modalities: str) -> Self:
        """Read what a user says: names separated by commas, for example ``color,hog``.

        For ``onnx:FILE`` the file is read, and the network gets the name that its contents have. The name of the file
        has no comma and no blank at its end. ValueError as above, or where a network's file cannot be used, or was not
        given.
        """
        return cls.of(_given(name.strip()) for name in modalities.split(","))

    def of_images(self) -> "FeatureSettings | None":
        """Return those that a colour image alone gives, or None where there are none."""
        kept = [k for k, name in enumerate(self.modalities) if modality_named(name).needs == "color"]
        if not kept:
            return None
        return FeatureSettings(tuple(self.modalities[k] for k in kept), tuple(self.weights[k] for k in kept))

    @property
    def text(self) -> str:
        """The modalities as `parse` reads them; ValueError where a network's file was not given to this process."""
        return ",".join(onnx.given_as(name) if name.startswith(onnx.PREFIX) else name for name in self.modalities)

    @property
    def size(self) -> int:
        """Length m of a feature vector."""
        return sum(modality_named(name).size for name in self.modalities)

    @property
    def needs(self) -> frozenset[Input]:
        """Which images of a frame these features are made of."""
        return frozenset(modality_named(name).needs for name in self.modalities)

    @property
    def slices(self) -> tuple[slice, ...]:
        """Where each modality lies in a feature vector."""
        ends = np.cumsum([modality_named(name).size for name in self.modalities]).tolist()
        return tuple(slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def unit_weights(self) -> tuple[float, ...]:
        """The weights, scaled so that their squares sum to 1."""
        # Squares of very small weights are zero, and of very large ones infinite.
        largest = max(self.weights)
        norm = math.hypot(*(weight / largest for weight in self.weights))
        return tuple(weight / largest / norm for weight in self.weights)

    @property
    def fingerprint(self) -> str:
        """12 hex digits naming these raw features; weights are applied later and do not enter.

        Of a network the contents of its file count, and not where it lies.
        """
        modalities = [modality_named(name) for name in self.modalities]
        text = json.dumps([DESCRIPTOR_VERSION, [[modality.name, modality.size] for modality in modalities]])
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def _given(name: str) -> str:
    """Return the name of a modality that a user names."""
    if not name.startswith(onnx.PREFIX):
        return name
    if onnx.is_digest(name):
        onnx.given_as(name)
        return name
    return onnx.open_network(name.removeprefix(onnx.PREFIX))
