"""Which modalities describe a frame."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from smal.features import onnx
from smal.features.modalities import modality_named
from smal.features.modality import Input

# Raised whenever any descriptor changes its output, so that a model never meets features it was not learned on.
DESCRIPTOR_VERSION = 1


@dataclass(frozen=True)
class FeatureSettings:
    """The modalities of a feature vector, in order; ValueError where one is unknown or repeated."""

    modalities: tuple[str, ...] = ("color", "hog")

    def __post_init__(self) -> None:
        if not self.size:
            raise ValueError("no feature modality is named that describes a frame")
        for number, name in enumerate(self.modalities):
            modality_named(name)
            if name in self.modalities[:number]:
                raise ValueError(f"the feature modality {name} is named twice")

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process with the names of the files of networks, which are read there."""
        return _arrived, (
            type(self),
            self.modalities,
            [onnx.said(name) for name in self.modalities],
        )

    @classmethod
    def of(cls, modalities: Iterable[str]) -> Self:
        """Make the settings of some modalities."""
        return cls(tuple(modalities))

    @classmethod
    def parse(cls, modalities: str) -> Self:
        """Read what a user says: names separated by commas, for example ``color,hog``.

        For ``onnx:FILE`` and ``boxes:FILE`` the file is read, and the network gets the name that its contents have. The
        name of the file has no comma and no blank at its end. ValueError as above, or where a network's file cannot be
        used, or was not given.
        """
        return cls.of(_given(name.strip()) for name in modalities.split(","))

    @classmethod
    def of_content(cls, meta: dict[str, Any]) -> Self:
        """Return the features that a model's file was learned on; ValueError where this program computes others."""
        settings = cls(tuple(meta["modalities"]))
        if settings.fingerprint != meta["feature_fingerprint"]:
            raise ValueError(
                "it was learned on features that this version computes differently; learn it again"
            )
        return settings

    @property
    def content(self) -> dict[str, Any]:
        """What a model's file says of them."""
        return {"modalities": self.modalities, "feature_fingerprint": self.fingerprint}

    @property
    def text(self) -> str:
        """The modalities as `parse` reads them; ValueError where a network's file was not given to this process."""
        return ",".join(
            onnx.given_as(name) if name.startswith(onnx.PREFIX) else name
            for name in self.modalities
        )

    @property
    def size(self) -> int:
        """Length m of a feature vector."""
        return sum(modality_named(name).size for name in self.modalities)

    @property
    def needs(self) -> frozenset[Input]:
        """Which images of a frame these features are made of."""
        return frozenset(modality_named(name).needs for name in self.modalities)

    @property
    def describing(self) -> tuple[str, ...]:
        """Those that are no detectors: what feature vectors are of."""
        return tuple(name for name in self.modalities if modality_named(name).size)

    @property
    def slices(self) -> tuple[slice, ...]:
        """Where each modality lies in a feature vector."""
        ends = np.cumsum([modality_named(name).size for name in self.modalities]).tolist()
        return tuple(slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def fingerprint(self) -> str:
        """12 hex digits naming these raw features; of a network the contents of its file count."""
        modalities = [modality_named(name) for name in self.modalities]
        text = json.dumps(
            [DESCRIPTOR_VERSION, [[modality.name, modality.size] for modality in modalities]]
        )
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def select(raw: NDArray[Any], held: FeatureSettings, wanted: FeatureSettings) -> NDArray[Any]:
    """Take the wanted modalities, in their order, out of raw features (..., m) of those that are held.

    ValueError where the last axis is not m, or a modality is wanted that is not held.
    """
    if raw.ndim == 0 or raw.shape[-1] != held.size:
        raise ValueError(f"features must have {held.size} entries, got the shape {raw.shape}")
    missing = [name for name in wanted.describing if name not in held.modalities]
    if missing:
        raise ValueError(
            f"the features {', '.join(held.modalities)} do not hold {', '.join(missing)}"
        )
    if held.describing == wanted.describing:
        return raw
    where = dict(zip(held.modalities, held.slices, strict=True))
    return np.concatenate([raw[..., where[name]] for name in wanted.describing], axis=-1)


def _arrived(
    kind: type[FeatureSettings], modalities: tuple[str, ...], said: Iterable[str]
) -> FeatureSettings:
    for name in said:
        if not onnx.is_digest(name):
            _given(name)
    return kind(modalities)


def _given(name: str) -> str:
    """Return the name of a modality that a user names."""
    if onnx.is_digest(name):
        onnx.given_as(name)
        return name
    kind, colon, file = name.partition(":")
    return (
        onnx.open_network(file, kind + colon) if kind + colon in (onnx.PREFIX, onnx.BOXES) else name
    )
