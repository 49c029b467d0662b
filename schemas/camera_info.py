"""How the robot's camera sees."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from schemas.base import Message


class CameraInfo(Message):
    """Calibration of the robot's camera: once an episode, with its first frame."""

    topic: ClassVar[str] = "camera/info"
    version: ClassVar[int] = 2
    reads: ClassVar[tuple[int, ...]] = (1,)

    width: Annotated[int, Field(ge=1, le=4096)]
    """Columns of the image that it is for; for another size it scales."""
    height: Annotated[int, Field(ge=1, le=3072)]
    """Rows of that image."""
    focal_px: Annotated[float, Field(ge=1.0, le=1e5)]
    """Focal length in pixels."""
    centre_x_px: Annotated[float, Field(ge=0.0, le=4096.0)]
    """Column of the optical axis, from the left edge of the image."""
    centre_y_px: Annotated[float, Field(ge=0.0, le=3072.0)]
    """Row of the optical axis, from the top edge of the image."""
    lens: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    """How the lens bends what it sees, by the names of ROS."""
    distortion: Annotated[tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...], Field(max_length=8)] = ()
    """Coefficients of that model, in the order of ROS; those that are left out are 0."""

    @model_validator(mode="after")
    def _sees(self) -> Self:
        # As `smal.camera.Camera` has it, of which this must always make one.
        if not 0.04 <= self.focal_px / self.width <= 12.0:
            raise ValueError("no camera has such a focal length for the width of its image")
        off = self.centre_x_px - self.width / 2, self.centre_y_px - self.height / 2
        if max(map(abs, off)) > self.width / 2:
            raise ValueError("the axis of a camera must meet its image")
        return self
