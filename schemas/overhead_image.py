"""Images of a camera that looks at the robot from above."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Strict
from schemas.compressed_image import CompressedImage


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

    version: ClassVar[int] = 2
    topic: ClassVar[str] = "camera/overhead"

    calibration: Calibration
    """How the camera sees."""
