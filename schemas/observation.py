"""What the features service makes of one camera frame."""

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from schemas.array import Float32Array
from schemas.base import Message, Strict

ModalityName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]

MOST_DETECTED = 1000  # Things that a frame's message has room for.
Share = Annotated[float, Field(ge=-0.5, le=1.5)]


class Detected(Strict):
    """Something that a detector has found in the frame."""

    label: Annotated[str, Field(max_length=100)]
    """The detector's name and which thing it is, as "apriltag 7"."""
    score: Annotated[float, Field(ge=0, le=1)]
    """How sure the detector is."""
    box: tuple[Share, Share, Share, Share]
    """Left, top, right and bottom, as shares of the frame's width and height."""


class Observation(Message):
    """Multimodal feature vector of one frame: each modality of unit length, concatenated, not yet centred."""

    topic: ClassVar[str] = "observation"
    max_bytes: ClassVar[int] = 4 * 1_000_000 + 16_384
    max_containers: ClassVar[int] = 8 + 2 * MOST_DETECTED

    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Which modalities, settings and code version made the vector; a model refuses another's."""
    modalities: Annotated[tuple[ModalityName, ...], Field(max_length=16)] = ()
    """Their names in the vector's order; empty if the file of a network is among them."""
    features: Float32Array
    """The vector, shape (m,)."""
    picture: Annotated[bytes, Field(max_length=14_400)] = b""
    """The frame as 60 rows of 80 pixels of RGB, for what sees a goal in it; empty where nobody made it."""
    detected: Annotated[tuple[Detected, ...], Field(max_length=MOST_DETECTED)] = ()
    """What the detectors among the modalities have found in it."""

    def small(self) -> NDArray[np.uint8] | None:
        """Return the picture (60, 80, 3), if there is one."""
        if len(self.picture) != 14_400:
            return None
        return np.frombuffer(self.picture, dtype=np.uint8).reshape(60, 80, 3)
