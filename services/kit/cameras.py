"""How a camera sees, from and to messages: ours, and `sensor_msgs/msg/CameraInfo` of ROS."""

from typing import Any

from schemas.base import Message
from schemas.camera import CameraInfo
from smal.camera import Camera


def camera_of(info: CameraInfo) -> Camera:
    """Return the camera that a message tells of."""
    width = info.width
    height = info.height
    centre = (info.centre_x_px - width / 2) / width, (info.centre_y_px - height / 2) / width
    return Camera(info.focal_px / width, info.lens, info.distortion, centre)


def camera_info(cause: Message, camera: Camera, width: int, height: int) -> CameraInfo:
    """Make the message of a camera whose images are of this size."""
    right, down = camera.centre
    # Another size of image may be cut.
    down = min(max(down, -height / width / 2), height / width / 2)
    return CameraInfo.after(
        cause, width=width, height=height, focal_px=camera.focal * width, centre_x_px=width / 2 + right * width,
        centre_y_px=height / 2 + down * width, lens=camera.lens, distortion=camera.distortion,
    )  # fmt: skip


def camera_of_ros(info: Any) -> Camera:  # noqa: ANN401 - its class is made of its definition
    """Return the camera that a message of ROS tells of; ValueError where it tells of none."""
    width = int(info.width)
    height = int(info.height)
    k = [float(one) for one in info.k]
    if width <= 0 or not k[0] > 0.0:
        raise ValueError("no focal length in it; the camera is not calibrated")
    distortion = tuple(float(one) for one in info.d)
    lens: Any = info.distortion_model if any(distortion) else info.distortion_model or "plumb_bob"
    return Camera(
        k[0] / width, lens, distortion, ((k[2] - width / 2) / width, (k[5] - height / 2) / width)
    )
