"""Where the robot is."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message


class Pose(Message):
    """True planar pose of the robot in the world (from the simulator; never seen by the method)."""

    topic: ClassVar[str] = "pose/truth"

    x_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """East of the world's origin, metres."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """North of the world's origin, metres."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Counter-clockwise from east, radians in (-pi, pi]."""
