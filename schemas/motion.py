"""Where the robot is, by whatever measures it, and how it moves."""

import itertools
from typing import Annotated, ClassVar, Final, Self

from pydantic import Field, model_validator

from schemas.base import Message, Strict


class TruePose(Message):
    """True planar pose of the robot in the world (from the simulator; never seen by the method)."""

    topic: ClassVar[str] = "pose/truth"

    x_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """East of the world's origin, metres."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """North of the world's origin, metres."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Counter-clockwise from east, radians in (-pi, pi]."""


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
            raise ValueError(
                "x_m, y_m, heading_rad and error_px are given exactly while the tag is visible"
            )
        return self


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


MAX_SAMPLES: Final = 100  # So many are kept of what was felt while no frame was taken.
Rate = Annotated[float, Field(ge=-100, le=100)]
Acceleration = Annotated[float, Field(ge=-1000, le=1000)]


class ImuSample(Strict):
    """One reading: x ahead, y to the left, z up, as ROS has it."""

    after_s: Annotated[float, Field(ge=0, le=1e6)]
    """When, seconds of simulated time since the episode began."""
    angular_velocity_rad_s: tuple[Rate, Rate, Rate]
    """About x (roll), y (pitch) and z (yaw)."""
    acceleration_m_s2: tuple[Acceleration, Acceleration, Acceleration]
    """Along x, y and z; 9.81 along z at rest."""


class Imu(Message):
    """Readings of the inertial unit since the frame before, oldest first."""

    topic: ClassVar[str] = "imu"
    max_containers: ClassVar[int] = 2 + 3 * MAX_SAMPLES

    samples: Annotated[tuple[ImuSample, ...], Field(max_length=MAX_SAMPLES)]
    """The readings; none with the first frame of an episode."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        times = [sample.after_s for sample in self.samples]
        if any(later <= earlier for earlier, later in itertools.pairwise(times)):
            raise ValueError("readings must be given in the order of time")
        return self
