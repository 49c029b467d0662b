"""Inertial measurements."""

import itertools
from typing import Annotated, ClassVar, Final, Self

from pydantic import Field, model_validator

from schemas.base import Message, Strict

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
