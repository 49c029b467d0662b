"""Camera images."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Message


class Image(Message):
    """One raw colour frame of the robot's camera."""

    topic: ClassVar[str] = "camera/rgb"
    max_bytes: ClassVar[int] = 3 * 4096 * 3072 + 1024

    width: Annotated[int, Field(ge=1, le=4096)]
    """Columns."""
    height: Annotated[int, Field(ge=1, le=3072)]
    """Rows."""
    data: bytes
    """Red, green, blue of each pixel, one byte each, row by row from the top left."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.data) != 3 * self.width * self.height:
            raise ValueError(f"{len(self.data)} bytes do not fill a {self.width}x{self.height} rgb8 image")
        return self

    def to_numpy(self) -> NDArray[np.uint8]:
        """Return the pixels as a read-only (height, width, 3) array that shares this message's bytes."""
        return np.frombuffer(self.data, dtype=np.uint8).reshape(self.height, self.width, 3)
