"""Camera images."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import Message


class CompressedImage(Message):
    """One colour frame of the robot's camera, as JPEG."""

    topic: ClassVar[str] = "camera/jpeg"
    max_bytes: ClassVar[int] = 16 * 1024 * 1024

    width: Annotated[int, Field(ge=1, le=4096)]
    """Columns."""
    height: Annotated[int, Field(ge=1, le=3072)]
    """Rows."""
    format: Literal["jpeg"] = "jpeg"
    """How it is compressed."""
    data: Annotated[bytes, Field(min_length=4)]
    """The compressed image."""
