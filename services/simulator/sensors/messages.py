"""Readings of the sensors as messages."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from schemas.camera_info import CameraInfo
from schemas.depth_image import DepthImage
from schemas.imu import Imu, ImuSample
from schemas.odometry import Odometry
from schemas.overhead_image import Calibration, OverheadImage

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from schemas.base import Message
    from services.simulator.sensors.imu import ImuReading, Triple
    from services.simulator.sensors.odometry import OdometryReading
    from services.simulator.world.place import OverheadMount

#: Largest depth image, pixels.
MOST_COLUMNS: Final = 320
MOST_ROWS: Final = 240
#: Farthest depth that is told; 16 bits of millimetres end there.
FARTHEST_M: Final = 65.0
# Digits after the point: a micrometre and a microradian, far below every noise, and a third of the bytes in recordings.
_DIGITS: Final = 6


def camera_info(header: Message, image: NDArray[np.uint8], focal_px: float) -> CameraInfo:
    """Make the message of how the camera of an image (height, width, 3) sees."""
    height, width, _ = image.shape
    return CameraInfo.after(
        header, width=width, height=height, focal_px=focal_px, centre_x_px=width / 2, centre_y_px=height / 2
    )


def depth_message(header: Message, depth_m: NDArray[np.float32]) -> DepthImage:
    """Make the message of a depth image, of every n-th pixel so that it is small.

    Parameters
    ----------
    header
        Robot, episode, tick and stamp.
    depth_m
        (height, width) metres along the camera's axis, `inf` where nothing is.
    """
    height, width = depth_m.shape
    every = max(1, math.ceil(width / MOST_COLUMNS), math.ceil(height / MOST_ROWS))
    # From the middle of each block, so that a pixel of the small image looks where its block does.
    coarse = depth_m[every // 2 :: every, every // 2 :: every]
    near = np.where(coarse <= FARTHEST_M, coarse, 0.0)
    rows, columns = near.shape
    return DepthImage.after(header, width=columns, height=rows, data=np.rint(1000 * near).astype("<u2").tobytes())


def overhead_message(header: Message, image: NDArray[np.uint8], mount: OverheadMount) -> OverheadImage:
    """Make the message of the overhead camera's image, (height, width, 3), with how that camera sees."""
    height, width, _ = image.shape
    calibration = Calibration(
        focal_px=mount.focal_px,
        centre_x_px=width / 2,
        centre_y_px=height / 2,
        x_m=mount.x,
        y_m=mount.y,
        height_m=mount.height_m,
        up_rad=math.remainder(mount.up, math.tau),
    )
    return OverheadImage.after(header, width=width, height=height, data=image.tobytes(), calibration=calibration)


def odometry_message(header: Message, reading: OdometryReading) -> Odometry:
    """Make the message of what the wheels tell."""
    fields = {name: round(value, _DIGITS) for name, value in reading._asdict().items()}
    return Odometry.after(header, **fields)


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
