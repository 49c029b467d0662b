"""Where the tracker sees the robot."""

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from schemas.base import Message


class TrackedPose(Message):
    """Planar pose of the robot as measured from the overhead image alone, or the news that its tag is not seen."""

    topic: ClassVar[str] = "pose/tracked"

    visible: bool
    """Whether the tag is in the image; without it the pose is unknown."""
    x_m: Annotated[float, Field(ge=-1e5, le=1e5)] | None = None
    """East of the world's origin, metres; None while the tag is lost."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)] | None = None
    """North of the world's origin, metres; None while the tag is lost."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)] | None = None
    """Counter-clockwise from east, radians in (-pi, pi]; None while the tag is lost."""
    error_px: Annotated[float, Field(ge=0, le=1e4)] | None = None
    """Root mean square distance of the tag's corners from where this pose puts them, pixels; None while lost."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        measured = (self.x_m, self.y_m, self.heading_rad, self.error_px)
        if any((value is not None) != self.visible for value in measured):
            raise ValueError("x_m, y_m, heading_rad and error_px are given exactly while the tag is visible")
        return self
