"""Readings of a body's sensors as messages."""

from collections.abc import Iterable
from typing import Final

from schemas.base import Message
from schemas.motion import Imu, ImuSample, Odometry
from services.robot.body import ImuReading, OdometryReading, Triple

# Digits after the point: a micrometre and a microradian, far below every noise, and a third of the bytes in recordings.
_DIGITS: Final = 6


def rounded(reading: OdometryReading) -> OdometryReading:
    """Return a reading with the digits that its message has."""
    return OdometryReading(*(round(value, _DIGITS) for value in reading))


def odometry_message(header: Message, reading: OdometryReading) -> Odometry:
    """Make the message of what the wheels tell."""
    return Odometry.after(header, **rounded(reading)._asdict())


def imu_message(header: Message, readings: Iterable[ImuReading]) -> Imu:
    """Make the message of the inertial readings since the frame before."""
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
