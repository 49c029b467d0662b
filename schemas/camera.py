"""What the cameras see, and how."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Message, Strict


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


class Mounting(Strict):
    """How the depth camera sits on a round robot, as `smal.obstacles.clearance.Mount` has it."""

    focal: Annotated[float, Field(ge=0.04, le=12.0)]
    """Focal length over the width of the image."""
    height_m: Annotated[float, Field(gt=0, le=10)]
    """Of the camera, above the ground."""
    ahead_m: Annotated[float, Field(ge=-10, le=10)]
    """Of the camera, ahead of the middle of the robot."""
    radius_m: Annotated[float, Field(ge=0.01, le=10)]
    """Of the robot."""
    top_m: Annotated[float, Field(gt=0, le=10)]
    """Height of the robot's highest point."""


class DepthImage(Message):
    """Distances along the camera's axis, one for each pixel of a coarse image of the same view."""

    topic: ClassVar[str] = "camera/depth"
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
            raise ValueError(
                f"{len(self.data)} bytes do not fill a {self.width}x{self.height} image of 16 bits"
            )
        return self

    def to_numpy(self) -> NDArray[np.uint16]:
        """Return the millimetres as a read-only (height, width) array that shares this message's bytes."""
        return np.frombuffer(self.data, dtype="<u2").reshape(self.height, self.width)


class Calibration(Strict):
    """A pinhole camera without distortion that hangs over the scene and looks straight down."""

    focal_px: Annotated[float, Field(gt=0, le=1e5)]
    """Focal length in pixels, of both axes."""
    centre_x_px: Annotated[float, Field(ge=0, le=4096)]
    """Where the optical axis meets the image, pixels from the left edge."""
    centre_y_px: Annotated[float, Field(ge=0, le=3072)]
    """Where the optical axis meets the image, pixels from the upper edge."""
    x_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """East of the world's origin, metres."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """North of the world's origin, metres."""
    height_m: Annotated[float, Field(gt=0, le=1e3)]
    """Above the floor, metres."""
    up_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Direction on the floor that points up in the image, counter-clockwise from east, radians in (-pi, pi]."""


class OverheadImage(CompressedImage):
    """One colour frame of the camera above the scene, as JPEG (ground truth only; never seen by the method)."""

    topic: ClassVar[str] = "camera/overhead"

    calibration: Calibration
    """How the camera sees."""


class CameraInfo(Message):
    """Calibration of the robot's camera: once an episode, with its first frame."""

    topic: ClassVar[str] = "camera/info"

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
    distortion: Annotated[
        tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...], Field(max_length=8)
    ] = ()
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
