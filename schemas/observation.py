"""What the features service makes of one camera frame."""

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from schemas.array import Float32Array
from schemas.base import Message

ModalityName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]


class Observation(Message):
    """Multimodal feature vector of one frame: each modality of unit length, concatenated, not yet centred."""

    version: ClassVar[int] = 3
    reads: ClassVar[tuple[int, ...]] = (1, 2)
    topic: ClassVar[str] = "observation"
    max_bytes: ClassVar[int] = 4 * 1_000_000 + 16_384

    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Which modalities, settings and code version made the vector; a model refuses another's."""
    modalities: Annotated[tuple[ModalityName, ...], Field(max_length=16)] = ()
    """Their names in the vector's order; none where a network's file is among them, and in version 1."""
    features: Float32Array
    """The vector, shape (m,)."""
    picture: Annotated[bytes, Field(max_length=14_400)] = b""
    """The frame as 60 rows of 80 pixels of RGB, for what sees a goal in it; empty where nobody made it."""

    def small(self) -> NDArray[np.uint8] | None:
        """Return the picture (60, 80, 3), if there is one."""
        if len(self.picture) != 14_400:
            return None
        return np.frombuffer(self.picture, dtype=np.uint8).reshape(60, 80, 3)
