"""Conversion of cameras to messages and back, for SMAL and ROS (`sensor_msgs/msg/CameraInfo`)."""

from dataclasses import replace
from typing import Any

from schemas.base import Message
from schemas.camera import CameraInfo
from smal.camera import Camera


def camera_of(info: CameraInfo) -> Camera:
    """Return the camera of a message."""
    width = info.width
    height = info.height
    centre = (info.centre_x_px - width / 2) / width, (info.centre_y_px - height / 2) / width
    return Camera(info.focal_px / width, info.lens, info.distortion, centre)


def camera_info(cause: Message, camera: Camera, width: int, height: int) -> CameraInfo:
    """Return the message of a camera for images of a size."""
    right, down = camera.centre
    # Another image size can be a crop, which leaves the centre outside.
    down = min(max(down, -height / width / 2), height / width / 2)
    return CameraInfo.after(
        cause, width=width, height=height, focal_px=camera.focal * width, centre_x_px=width / 2 + right * width,
        centre_y_px=height / 2 + down * width, lens=camera.lens, distortion=camera.distortion,
    )  # fmt: skip


def camera_of_ros(info: Any) -> Camera:  # noqa: ANN401 - its class is made of its definition
    """Return the camera of a ROS message; ValueError if it is not calibrated."""
    width = int(info.width)
    height = int(info.height)
    # ROS 1 spells the fields K and D.
    k = [float(one) for one in (info.k if hasattr(info, "k") else info.K)]
    if width <= 0 or not k[0] > 0.0:
        raise ValueError("no focal length: the camera is not calibrated")
    distortion = tuple(float(one) for one in (info.d if hasattr(info, "d") else info.D))
    lens = info.distortion_model if any(distortion) else info.distortion_model or "plumb_bob"
    return calibrated((width, height), (k[0], k[2], k[5]), lens, distortion)


def calibrated(
    size: tuple[int, int],
    intrinsics_px: tuple[float, float, float],
    lens: Any = "plumb_bob",  # noqa: ANN401 - any text of a file
    distortion: tuple[float, ...] = (),
) -> Camera:
    """Return the camera of a calibration: focal length, column and row of the axis, in pixels."""
    width, height = size
    focal, column, row = intrinsics_px
    centre = (column - width / 2) / width, (row - height / 2) / width
    return Camera(focal / width, lens, distortion, centre)


def turned(camera: Camera, clockwise_deg: int, aspect: float) -> Camera:
    """Return the camera of images turned by a multiple of 90 degrees.

    Parameters
    ----------
    camera
        Camera of the images before the turn.
    clockwise_deg
        Turn of the images, degrees.
    aspect
        Height over width of the images before the turn.
    """
    for _ in range(clockwise_deg // 90):
        right, down = camera.centre
        focal = camera.focal / aspect
        camera = replace(camera, focal=focal, centre=(-down / aspect, right / aspect))
        aspect = 1.0 / aspect
    return camera
