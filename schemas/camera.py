"""Images and calibrations of the cameras."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Message, Strict


class CompressedImage(Message):
    """Colour frame of the robot's camera, as JPEG."""

    topic: ClassVar[str] = "camera/jpeg"
    max_bytes: ClassVar[int] = 16 * 1024 * 1024

    width: Annotated[int, Field(ge=1, le=4096)]
    """Columns."""
    height: Annotated[int, Field(ge=1, le=3072)]
    """Rows."""
    format: Literal["jpeg"] = "jpeg"
    """Compression."""
    data: Annotated[bytes, Field(min_length=4)]
    """Compressed image."""


class Mounting(Strict):
    """Position of the depth camera on a round robot, as in `smal.obstacles.clearance.Mount`."""

    focal: Annotated[float, Field(ge=0.04, le=12.0)]
    """Focal length as a share of the image width."""
    height_m: Annotated[float, Field(gt=0, le=10)]
    """Height of the camera above the ground, metres."""
    ahead_m: Annotated[float, Field(ge=-10, le=10)]
    """Distance of the camera ahead of the robot's centre, metres."""
    radius_m: Annotated[float, Field(ge=0.01, le=10)]
    """Radius of the robot, metres."""
    top_m: Annotated[float, Field(gt=0, le=10)]
    """Height of the robot's highest point, metres."""


class DepthImage(Message):
    """Depth image: distances along the camera's axis, for a coarse image of the same view."""

    topic: ClassVar[str] = "camera/depth"
    max_bytes: ClassVar[int] = 2 * 1024 * 768 + 1024

    width: Annotated[int, Field(ge=1, le=1024)]
    """Columns."""
    height: Annotated[int, Field(ge=1, le=768)]
    """Rows."""
    data: bytes
    """Millimetres as 16-bit little-endian numbers, row by row from the top left; 0 if unknown.
    """
    mounting: Mounting | None = None
    """Position of the camera, if the image serves to detect obstacles."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.data) != 2 * self.width * self.height:
            raise ValueError(
                f"{len(self.data)} bytes do not fill a {self.width}x{self.height} image of 16 bits"
            )
        return self

    def to_numpy(self) -> NDArray[np.uint16]:
        """Return the millimetres as a read-only (height, width) view of this message's bytes."""
        return np.frombuffer(self.data, dtype="<u2").reshape(self.height, self.width)


class Calibration(Strict):
    """Pinhole camera without distortion above the scene, which looks straight down."""

    focal_px: Annotated[float, Field(gt=0, le=1e5)]
    """Focal length of both axes, pixels."""
    centre_x_px: Annotated[float, Field(ge=0, le=4096)]
    """Column of the optical axis, pixels from the left edge."""
    centre_y_px: Annotated[float, Field(ge=0, le=3072)]
    """Row of the optical axis, pixels from the upper edge."""
    x_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """East of the world's origin, metres."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """North of the world's origin, metres."""
    height_m: Annotated[float, Field(gt=0, le=1e3)]
    """Above the floor, metres."""
    up_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Direction on the floor that points up in the image, counter-clockwise from east, radians in
    (-pi, pi].
    """


class OverheadImage(CompressedImage):
    """Colour frame of the camera above the scene, as JPEG (ground truth, unused by the method)."""

    topic: ClassVar[str] = "camera/overhead"

    calibration: Calibration
    """Calibration of the overhead camera."""


class CameraInfo(Message):
    """Calibration of the robot's camera, sent once an episode with its first frame."""

    topic: ClassVar[str] = "camera/info"

    width: Annotated[int, Field(ge=1, le=4096)]
    """Columns of the image that the calibration is for; it scales to other sizes."""
    height: Annotated[int, Field(ge=1, le=3072)]
    """Rows of that image."""
    focal_px: Annotated[float, Field(ge=1.0, le=1e5)]
    """Focal length, pixels."""
    centre_x_px: Annotated[float, Field(ge=0.0, le=4096.0)]
    """Column of the optical axis, pixels from the left edge."""
    centre_y_px: Annotated[float, Field(ge=0.0, le=3072.0)]
    """Row of the optical axis, pixels from the upper edge."""
    lens: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    """Distortion model, named as in ROS."""
    distortion: Annotated[
        tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...], Field(max_length=8)
    ] = ()
    """Coefficients of the distortion model, in the order of ROS; missing coefficients are 0."""

    @model_validator(mode="after")
    def _sees(self) -> Self:
        # Every valid message must convert to a `smal.camera.Camera`, which has the same limits.
        if not 0.04 <= self.focal_px / self.width <= 12.0:
            raise ValueError(
                f"invalid focal_px {self.focal_px:g}: must be 0.04 to 12 times the width {self.width}"
            )
        off = self.centre_x_px - self.width / 2, self.centre_y_px - self.height / 2
        if max(map(abs, off)) > self.width / 2:
            raise ValueError("invalid centre: the optical axis must meet the image")
        return self
