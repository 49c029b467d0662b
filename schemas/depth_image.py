"""Depth images."""

from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Message, Strict


class Mounting(Strict):
    """How the depth camera sits on a round robot, as `smal.obstacles.clearance.Mount` has it."""

    focal: Annotated[float, Field(ge=0.04, le=12.0)]
    """Focal length over the width of the image."""
    height_m: Annotated[float, Field(gt=0, le=10)]
    """Of the camera, above the ground."""
    ahead_m: Annotated[float, Field(ge=-10, le=10)]
    """Of the camera, ahead of the middle of the robot."""
    radius_m: Annotated[float, Field(gt=0, le=10)]
    """Of the robot."""
    top_m: Annotated[float, Field(gt=0, le=10)]
    """Height of the robot's highest point."""


class DepthImage(Message):
    """Distances along the camera's axis, one for each pixel of a coarse image of the same view."""

    topic: ClassVar[str] = "camera/depth"
    version: ClassVar[int] = 2
    reads: ClassVar[tuple[int, ...]] = (1,)
    max_bytes: ClassVar[int] = 2 * 1024 * 768 + 1024

    width: Annotated[int, Field(ge=1, le=1024)]
    """Columns."""
    height: Annotated[int, Field(ge=1, le=768)]
    """Rows."""
    data: bytes
    """Millimetres as 16-bit little-endian numbers, row by row from the top left; 0 where nothing is in range."""
    mounting: Mounting | None = None
    """How the camera sits, where it tells what the robot may run into."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.data) != 2 * self.width * self.height:
            raise ValueError(f"{len(self.data)} bytes do not fill a {self.width}x{self.height} image of 16 bits")
        return self

    def to_numpy(self) -> NDArray[np.uint16]:
        """Return the millimetres as a read-only (height, width) array that shares this message's bytes."""
        return np.frombuffer(self.data, dtype="<u2").reshape(self.height, self.width)
