"""What the features service makes of one camera frame."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.array import Float32Array
from schemas.base import Message

ModalityName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]


class Observation(Message):
    """Multimodal feature vector of one frame: each modality of unit length, concatenated, not yet centred."""

    version: ClassVar[int] = 2
    reads: ClassVar[tuple[int, ...]] = (1,)
    topic: ClassVar[str] = "observation"
    max_bytes: ClassVar[int] = 4 * 1_000_000 + 1024

    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Which modalities, settings and code version made the vector; a model refuses another's."""
    modalities: Annotated[tuple[ModalityName, ...], Field(max_length=16)] = ()
    """Their names in the vector's order; none where a network's file is among them, and in version 1."""
    features: Float32Array
    """The vector, shape (m,)."""
