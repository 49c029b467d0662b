"""Features of camera frames."""

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from schemas.array import Float32Array
from schemas.base import Message, Strict

ModalityName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]

MOST_DETECTED = 1000
Share = Annotated[float, Field(ge=-0.5, le=1.5)]


class Detected(Strict):
    """Detection in the frame."""

    label: Annotated[str, Field(max_length=100)]
    """Name of the detector and class of the object, for example "apriltag 7"."""
    score: Annotated[float, Field(ge=0, le=1)]
    """Confidence of the detector."""
    box: tuple[Share, Share, Share, Share]
    """Left, top, right and bottom, as shares of the frame's width and height."""


class Observation(Message):
    """Multimodal feature vector of one frame: unit-length modalities, not centred."""

    topic: ClassVar[str] = "observation"
    max_bytes: ClassVar[int] = 4 * 1_000_000 + 16_384
    max_containers: ClassVar[int] = 8 + 2 * MOST_DETECTED

    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Fingerprint of the modalities, settings and code version; a model refuses any other."""
    modalities: Annotated[tuple[ModalityName, ...], Field(max_length=16)] = ()
    """Names of the modalities in the vector's order; empty if they include a network's file."""
    features: Float32Array
    """Feature vector, shape (m,)."""
    picture: Annotated[bytes, Field(max_length=14_400)] = b""
    """Frame as 60 rows of 80 RGB pixels, for the target detector; empty if not computed."""
    detected: Annotated[tuple[Detected, ...], Field(max_length=MOST_DETECTED)] = ()
    """Detections of the modalities that are detectors."""

    def small(self) -> NDArray[np.uint8] | None:
        """Return the picture (60, 80, 3), or None if the message has none."""
        if len(self.picture) != 14_400:
            return None
        return np.frombuffer(self.picture, dtype=np.uint8).reshape(60, 80, 3)
