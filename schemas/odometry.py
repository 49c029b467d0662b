"""Dead reckoning by the wheels."""

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message


class Odometry(Message):
    """Planar pose by counting the wheels' turns since the start of the episode; drifts as wheels slip."""

    topic: ClassVar[str] = "odometry"

    x_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Ahead of where the episode began, metres."""
    y_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """To the left of where the episode began, metres."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Counter-clockwise from the first heading, radians in (-pi, pi]."""
    speed_m_s: Annotated[float, Field(ge=-100, le=100)]
    """Mean forward speed since the frame before."""
    turn_rate_rad_s: Annotated[float, Field(ge=-100, le=100)]
    """Mean turn rate since the frame before, counter-clockwise."""
