"""Arrays on the wire: element type, shape and little-endian bytes."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Strict


class Float32Array(Strict):
    """Finite float32 array in C order."""

    dtype: Literal["float32"] = "float32"
    """Element type, little endian."""
    shape: Annotated[
        tuple[Annotated[int, Field(ge=0, le=1_000_000)], ...], Field(min_length=1, max_length=4)
    ]
    """Lengths of the axes, outermost first."""
    data: bytes
    """Elements, row by row."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.data) != 4 * math.prod(self.shape):
            raise ValueError(f"{len(self.data)} bytes do not fill float32 of shape {self.shape}")
        if not bool(np.isfinite(self.to_numpy()).all()):
            raise ValueError("array holds NaN or infinity")
        return self

    @classmethod
    def from_numpy(cls, array: NDArray[np.float32]) -> Self:
        """Pack an array; its elements are copied."""
        return cls(
            shape=tuple(array.shape), data=np.ascontiguousarray(array, dtype="<f4").tobytes()
        )

    def to_numpy(self) -> NDArray[np.float32]:
        """Return the elements as a read-only array that shares this message's bytes."""
        return np.frombuffer(self.data, dtype="<f4").reshape(self.shape)
