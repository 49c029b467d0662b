"""Readings of a body's sensors as messages."""

import math
from collections.abc import Iterable
from typing import Final

from schemas.base import Message
from schemas.motion import Imu, ImuSample, Odometry
from services.robot.body import ImuReading, OdometryReading, Triple

# Decimal digits: micrometres and microradians are below the noise, and save a third of a recording.
_DIGITS: Final = 6


def rounded(reading: OdometryReading) -> OdometryReading:
    """Round a reading to the digits of its message."""
    return OdometryReading(*(round(value, _DIGITS) for value in reading))


def odometry_message(header: Message, reading: OdometryReading) -> Odometry:
    """Return the message of an odometry reading."""
    within = math.remainder(reading.heading_rad, math.tau)
    return Odometry.after(header, **rounded(reading._replace(heading_rad=within))._asdict())


def imu_message(header: Message, readings: Iterable[ImuReading]) -> Imu:
    """Return the message of the inertial readings since the previous frame."""
    samples = tuple(
        ImuSample(
            after_s=round(reading.after_s, _DIGITS),
            angular_velocity_rad_s=_rounded(reading.angular_velocity_rad_s),
            acceleration_m_s2=_rounded(reading.acceleration_m_s2),
        )
        for reading in readings
    )
    return Imu.after(header, samples=samples)


def _rounded(values: Triple) -> Triple:
    x, y, z = (round(value, _DIGITS) for value in values)
    return x, y, z
