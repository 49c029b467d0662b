"""Bags of ROS 2 as ``ros2 bag record -s mcap`` writes them, one for each drive.

Frames follow REP 105: ``odom`` is the start of the episode, ``base_link`` the robot. Recordings do
not contain the mount of the camera, which is placed at ``base_link`` and looks ahead.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.base import TICK_S
from schemas.camera import CameraInfo
from schemas.motion import Imu, Odometry
from services.exporters.drives import ExportedDrive
from services.importers import streams as names
from services.importers.bags import typestore
from services.importers.drive import Tally
from services.kit.errors import JobError
from services.kit.ros_message import ros_message

_IMU: Final = "sensor_msgs/msg/Imu"
_TF: Final = "tf2_msgs/msg/TFMessage"
_ODOM = "odom"
_BASE = "base_link"
_CAMERA = "camera_optical_frame"
_LATEST_NS: Final = 2**31 * 1_000_000_000  # ROS has seconds since 1970 in 31 bits.
#: Robot (ahead, left, up) to camera (right, down, ahead).
_OPTICAL: Final = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}
#: Number of coefficients of each lens model in ROS.
_COEFFICIENTS: Final = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
Fields = dict[str, Any]
Said = tuple[str, str, int, Fields]  # Topic, type, stamp in nanoseconds, and fields of a message.


def write(
    drives: Sequence[ExportedDrive], folder: Path, tally: Tally, advance: Callable[[], None]
) -> None:
    """Write a bag for each drive, by its name."""
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - of the extra `formats`

    store = typestore()
    for drive in drives:
        writer = Writer(
            folder / drive.name, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP
        )
        for what in ("robot", "episode", "world", "purpose", "goal", "outcome"):
            writer.set_custom_data(f"smal.{what}", getattr(drive, what) or "")
        channels: dict[str, Any] = {}
        with writer:
            for topic, kind, stamp_ns, fields in _said(drive, tally, advance):
                if topic not in channels:
                    qos = [_latched()] if topic == "/tf_static" else []
                    channels[topic] = writer.add_connection(
                        topic, kind, typestore=store, offered_qos_profiles=qos
                    )
                data = store.serialize_cdr(ros_message(store, kind, fields), kind)
                writer.write(channels[topic], stamp_ns, data)
        tally.count("drives have no odometry; a 3D view shows no movement", int(not drive.odometry))


def _said(drive: ExportedDrive, tally: Tally, advance: Callable[[], None]) -> Iterator[Said]:
    """Yield topic, type, stamp and fields of each message."""
    began_ns: int | None = None
    for moment in drive.moments(tally, advance):
        stamp_ns = moment.stamp_ns
        if began_ns is None:
            began_ns = stamp_ns - round(moment.tick * TICK_S * 1e9)
            yield "/tf_static", _TF, stamp_ns, _transforms(stamp_ns, (_BASE, _CAMERA), {}, _OPTICAL)
        if moment.imu is not None:
            yield from _felt(moment.imu, began_ns)
        if moment.odometry is not None:
            yield from _moved(moment.odometry, stamp_ns)
        if moment.jpeg is not None:
            yield from _seen(moment.jpeg, drive.camera, stamp_ns)
        if moment.velocity is not None:
            command = {"header": _header(stamp_ns, _BASE), "twist": _twist(*moment.velocity)}
            yield "/cmd_vel", names.STAMPED, stamp_ns, command


def _felt(imu: Imu, began_ns: int) -> Iterator[Said]:
    for sample in imu.samples:
        at_ns = began_ns + round(sample.after_s * 1e9)
        vectors = (sample.angular_velocity_rad_s, sample.acceleration_m_s2)
        turning, push = (dict(zip("xyz", vector, strict=True)) for vector in vectors)
        felt = {
            "header": _header(at_ns, _BASE),
            "angular_velocity": turning,
            "linear_acceleration": push,
            # The orientation was not measured.
            "orientation": {"w": 1.0},
            "orientation_covariance": np.array([-1.0, *[0.0] * 8]),
        }
        yield "/imu", _IMU, at_ns, felt


def _moved(pose: Odometry, stamp_ns: int) -> Iterator[Said]:
    place = {"x": pose.x_m, "y": pose.y_m}
    turn = {"z": math.sin(pose.heading_rad / 2.0), "w": math.cos(pose.heading_rad / 2.0)}
    odometry = {
        "header": _header(stamp_ns, _ODOM),
        "child_frame_id": _BASE,
        "pose": {"pose": {"position": place, "orientation": turn}},
        "twist": {"twist": _twist(pose.speed_m_s, pose.turn_rate_rad_s)},
    }
    yield "/odom", names.ODOMETRY, stamp_ns, odometry
    yield "/tf", _TF, stamp_ns, _transforms(stamp_ns, (_ODOM, _BASE), place, turn)


def _seen(jpeg: bytes, camera: CameraInfo | None, stamp_ns: int) -> Iterator[Said]:
    header = _header(stamp_ns, _CAMERA)
    image = {"header": header, "format": "jpeg", "data": np.frombuffer(jpeg, np.uint8)}
    yield "/camera/image_raw/compressed", names.COMPRESSED, stamp_ns, image
    if camera is not None:
        info = {"header": header, **_sees(camera)}
        yield "/camera/camera_info", names.INFO, stamp_ns, info


def _sees(camera: CameraInfo) -> Fields:
    focal = camera.focal_px
    x = camera.centre_x_px
    y = camera.centre_y_px
    distortion = np.zeros(_COEFFICIENTS[camera.lens])
    distortion[: len(camera.distortion)] = camera.distortion
    matrix = np.array([[focal, 0.0, x, 0.0], [0.0, focal, y, 0.0], [0.0, 0.0, 1.0, 0.0]])
    return {
        "height": camera.height, "width": camera.width, "distortion_model": camera.lens, "d": distortion,
        "k": matrix[:, :3].ravel(), "r": np.eye(3).ravel(), "p": matrix.ravel(),
    }  # fmt: skip


def _twist(linear: float, angular: float) -> Fields:
    return {"linear": {"x": linear}, "angular": {"z": angular}}


def _transforms(stamp_ns: int, frames: tuple[str, str], place: Fields, turn: Fields) -> Fields:
    transform = {"transform": {"translation": place, "rotation": turn}}
    return {
        "transforms": [
            transform | {"header": _header(stamp_ns, frames[0]), "child_frame_id": frames[1]}
        ]
    }


def _header(stamp_ns: int, frame: str) -> Fields:
    if not 0 <= stamp_ns < _LATEST_NS:
        raise JobError(f"time {stamp_ns / 1e9:.0f} s after 1970 is too large for ROS")
    seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": rest_ns}, "frame_id": frame}


def _latched() -> Any:  # noqa: ANN401 - of a package without types
    """Return the quality-of-service profile of a latched topic."""
    from rosbags import interfaces as ros  # noqa: PLC0415 - of the extra `formats`

    for_ever = ros.QosTime(*divmod(2**63 - 1, 1_000_000_000))
    usual = ros.QosHistory.KEEP_LAST, 1, ros.QosReliability.RELIABLE
    kept = (
        ros.QosDurability.TRANSIENT_LOCAL,
        for_ever,
        for_ever,
        ros.QosLiveliness.AUTOMATIC,
        for_ever,
    )
    return ros.Qos(*usual, *kept, avoid_ros_namespace_conventions=False)
