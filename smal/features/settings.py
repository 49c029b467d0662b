"""Selection of the modalities that describe a frame."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from smal.arrays import AnyArray
from smal.features import onnx
from smal.features.modalities import modality_named
from smal.features.modality import Input

# Increased whenever a descriptor changes its output, so that a model never meets features it was not learned on.
DESCRIPTOR_VERSION = 2


@dataclass(frozen=True)
class FeatureSettings:
    """Modalities of a feature vector, in order; ValueError if one is unknown or repeated."""

    modalities: tuple[str, ...] = ("color", "hog")

    def __post_init__(self) -> None:
        if not self.size:
            raise ValueError("no feature modality is named that describes a frame")
        for number, name in enumerate(self.modalities):
            modality_named(name)
            if name in self.modalities[:number]:
                raise ValueError(f"the feature modality {name} is named twice")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with the files of the networks, which the other process reads."""
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
        """Parse names separated by commas, for example ``color,hog``.

        The file of ``onnx:FILE`` and ``boxes:FILE`` is read, and the network is named by its contents. The file name
        must not contain a comma, or end with a blank. ValueError if a name is invalid, or a network's file is
        unsuitable or missing.
        """
        return cls.of(_given(name.strip()) for name in modalities.split(","))

    @classmethod
    def of_content(cls, meta: dict[str, Any]) -> Self:
        """Return the features of a model's file; ValueError if this program computes other features."""
        settings = cls(tuple(meta["modalities"]))
        if settings.fingerprint != meta["feature_fingerprint"]:
            raise ValueError(
                "it was learned on features that this version computes differently; learn it again"
            )
        return settings

    @property
    def content(self) -> dict[str, Any]:
        """Metadata for a model's file."""
        return {"modalities": self.modalities, "feature_fingerprint": self.fingerprint}

    @property
    def text(self) -> str:
        """The modalities as `parse` reads them; ValueError if a network's file was not given to this process."""
        return ",".join(
            onnx.given_as(name) if name.startswith(onnx.PREFIX) else name
            for name in self.modalities
        )

    @property
    def size(self) -> int:
        """Length m of a feature vector."""
        return sum(modality_named(name).size for name in self.modalities)

    @property
    def pixels(self) -> tuple[int, int]:
        """Rows and columns of an image at which these features look."""
        shapes = [modality_named(name).pixels for name in self.describing]
        return max([rows for rows, _ in shapes]), max([columns for _, columns in shapes])

    @property
    def needs(self) -> frozenset[Input]:
        """Images of a frame that these features need."""
        return frozenset(modality_named(name).needs for name in self.modalities)

    @property
    def describing(self) -> tuple[str, ...]:
        """The modalities with a descriptor, without the detectors."""
        return tuple(name for name in self.modalities if modality_named(name).size)

    @property
    def computable(self) -> bool:
        """Whether this process can compute the descriptors; a network needs its file."""
        return all(map(onnx.runs_here, self.describing))

    @property
    def slices(self) -> tuple[slice, ...]:
        """Slice of each modality in a feature vector."""
        ends = np.cumsum([modality_named(name).size for name in self.modalities]).tolist()
        return tuple(slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def fingerprint(self) -> str:
        """12 hex digits that identify these raw features, including the contents of networks."""
        modalities = [modality_named(name) for name in self.modalities]
        text = json.dumps(
            [DESCRIPTOR_VERSION, [[modality.name, modality.size] for modality in modalities]]
        )
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def select(raw: AnyArray, held: FeatureSettings, wanted: FeatureSettings) -> AnyArray:
    """Select modalities, in the wanted order, from raw features (..., m) of the held modalities.

    ValueError if the last axis is not m, or a wanted modality is missing.
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
    """Return the name of a modality, after reading the file of a network."""
    if onnx.is_digest(name):
        onnx.given_as(name)
        return name
    kind, colon, file = name.partition(":")
    return (
        onnx.open_network(file, kind + colon) if kind + colon in (onnx.PREFIX, onnx.BOXES) else name
    )
