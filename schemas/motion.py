"""Poses and motion of the robot, by source of measurement."""

import itertools
from typing import Annotated, ClassVar, Final, Self

from pydantic import Field, model_validator

from schemas.base import Message, Strict


class _Planar(Message):
    x_m: float
    y_m: float
    heading_rad: float

    @property
    def pose(self) -> tuple[float, float, float]:
        """X and y in metres, heading in radians."""
        return self.x_m, self.y_m, self.heading_rad


class TruePose(_Planar):
    """Ground truth: planar pose of the robot in the world (unused by the method)."""

    topic: ClassVar[str] = "pose/truth"

    x_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """East of the world's origin, metres."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)]
    """North of the world's origin, metres."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Counter-clockwise from east, radians in (-pi, pi]."""


class TrackedPose(Message):
    """Planar pose of the robot, measured from the overhead image alone by its tag."""

    topic: ClassVar[str] = "pose/tracked"

    visible: bool
    """Whether the tag is in the image; otherwise the pose is unknown."""
    x_m: Annotated[float, Field(ge=-1e5, le=1e5)] | None = None
    """East of the world's origin, metres; None while the tag is lost."""
    y_m: Annotated[float, Field(ge=-1e5, le=1e5)] | None = None
    """North of the world's origin, metres; None while the tag is lost."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)] | None = None
    """Counter-clockwise from east, radians in (-pi, pi]; None while the tag is lost."""
    error_px: Annotated[float, Field(ge=0, le=1e4)] | None = None
    """Root mean square reprojection error of the tag's corners, pixels; None while it is lost."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        measured = (self.x_m, self.y_m, self.heading_rad, self.error_px)
        if any((value is not None) != self.visible for value in measured):
            raise ValueError(
                "x_m, y_m, heading_rad and error_px are given exactly while the tag is visible"
            )
        return self


class Odometry(_Planar):
    """Planar pose by wheel odometry since the start of the episode; drifts as wheels slip."""

    topic: ClassVar[str] = "odometry"

    x_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Ahead of the start of the episode, metres."""
    y_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """To the left of the start of the episode, metres."""
    heading_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """Counter-clockwise from the first heading, radians in (-pi, pi]."""
    speed_m_s: Annotated[float, Field(ge=-100, le=100)]
    """Mean forward speed since the previous frame."""
    turn_rate_rad_s: Annotated[float, Field(ge=-100, le=100)]
    """Mean turn rate since the previous frame, counter-clockwise."""


MAX_SAMPLES: Final = 100
Rate = Annotated[float, Field(ge=-100, le=100)]
Acceleration = Annotated[float, Field(ge=-1000, le=1000)]


class ImuSample(Strict):
    """Reading of the inertial unit: x ahead, y to the left, z up, as in ROS."""

    after_s: Annotated[float, Field(ge=0, le=1e6)]
    """Seconds of simulated time since the episode began."""
    angular_velocity_rad_s: tuple[Rate, Rate, Rate]
    """About x (roll), y (pitch) and z (yaw)."""
    acceleration_m_s2: tuple[Acceleration, Acceleration, Acceleration]
    """Along x, y and z; 9.81 along z at rest."""


class Imu(Message):
    """Readings of the inertial unit since the previous frame, oldest first."""

    topic: ClassVar[str] = "imu"
    max_containers: ClassVar[int] = 2 + 3 * MAX_SAMPLES

    samples: Annotated[tuple[ImuSample, ...], Field(max_length=MAX_SAMPLES)]
    """The readings; empty for the first frame of an episode."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        times = [sample.after_s for sample in self.samples]
        if any(later <= earlier for earlier, later in itertools.pairwise(times)):
            raise ValueError("samples must be in the order of time")
        return self
