"""Bags of ROS 2 as ``ros2 bag record -s mcap`` writes them, one for each drive; images are copied to the byte.

Frames are those of REP 105: ``odom`` is where the episode began, ``base_link`` the robot. Where the camera sits was not
recorded: it is drawn at ``base_link`` and looks ahead, as all of our robots' do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.camera_info import CameraInfo
from schemas.imu import ImuSample
from schemas.odometry import Odometry
from services.exporters.drives import Drive, ExportFailure, Moment, Velocity
from services.importers import rosbag2 as names
from services.importers.drive import Tally
from services.importers.resample import TICK_S

_IMU: Final = "sensor_msgs/msg/Imu"
_TF: Final = "tf2_msgs/msg/TFMessage"
_ODOM, _BASE, _CAMERA = "odom", "base_link", "camera_optical_frame"
#: ROS has seconds since 1970 in 31 bits.
_LATEST_NS: Final = 2**31 * 1_000_000_000
#: From a robot's axes (ahead, left, up) to a camera's (right, down, ahead): x, y, z, w.
_OPTICAL: Final = (-0.5, 0.5, -0.5, 0.5)
#: Of a measurement that there is not, or whose errors are not known.
_ABSENT: Final = -1.0


def write(drives: Sequence[Drive], folder: Path, tally: Tally, advance: Callable[[], None]) -> None:
    """Write a bag for each drive, by its name."""
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - of the extra `formats`

    for drive in drives:
        writer = Writer(folder / drive.name, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        episode = drive.episode
        said = {
            "robot": episode.robot, "episode": episode.episode, "world": episode.world, "purpose": episode.purpose,
            "goal": episode.goal, "outcome": episode.outcome,
        }  # fmt: skip
        for what, value in said.items():
            writer.set_custom_data(f"smal.{what}", value or "")
        with writer:
            bag = _Bag(writer, drive.camera)
            for moment in drive.moments(tally):
                advance()
                bag.add(moment)
        tally.count("drives have no odometry: nothing moves in a 3D view", int(not episode.odometry))


class _Bag:
    """Makes messages of ROS, and writes them."""

    def __init__(self, writer: Any, camera: CameraInfo | None) -> None:  # noqa: ANN401 - of a package without types
        self._store = names.typestore()
        self._writer = writer
        self._camera = camera
        self._channels: dict[str, Any] = {}
        self._began_ns: int | None = None

    def add(self, moment: Moment) -> None:
        """Write what there is at one tick."""
        stamp_ns = moment.stamp_ns
        if self._began_ns is None:
            self._began_ns = stamp_ns - round(moment.tick * TICK_S * 1e9)
            fixed = self._transform(stamp_ns, (_BASE, _CAMERA), (0.0, 0.0), _OPTICAL)
            self._write("/tf_static", _TF, stamp_ns, self._of(_TF, transforms=[fixed]))
        for sample in moment.imu.samples if moment.imu else ():
            self._imu(self._began_ns + round(sample.after_s * 1e9), sample)
        if moment.pose is not None:
            self._odometry(stamp_ns, moment.pose)
        if moment.jpeg is not None:
            self._image(stamp_ns, moment.jpeg)
        if moment.velocity is not None:
            stamped = self._of(names.STAMPED, header=self._header(stamp_ns, _BASE), twist=self._twist(moment.velocity))
            self._write("/cmd_vel", names.STAMPED, stamp_ns, stamped)

    def _image(self, stamp_ns: int, jpeg: bytes) -> None:
        header, data = self._header(stamp_ns, _CAMERA), np.frombuffer(jpeg, np.uint8)
        image = self._of(names.COMPRESSED, header=header, format="jpeg", data=data)
        self._write("/camera/image_raw/compressed", names.COMPRESSED, stamp_ns, image)
        if self._camera is not None:
            self._write("/camera/camera_info", names.INFO, stamp_ns, self._info(stamp_ns, self._camera))

    def _info(self, stamp_ns: int, camera: CameraInfo) -> Any:  # noqa: ANN401 - as above
        focal, x, y = camera.focal_px, camera.centre_x_px, camera.centre_y_px
        matrix = np.array([[focal, 0.0, x, 0.0], [0.0, focal, y, 0.0], [0.0, 0.0, 1.0, 0.0]])
        whole = self._of(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._of(
            names.INFO, header=self._header(stamp_ns, _CAMERA), height=camera.height, width=camera.width,
            distortion_model="plumb_bob", d=np.zeros(5), k=matrix[:, :3].ravel(), r=np.eye(3).ravel(), p=matrix.ravel(),
            binning_x=0, binning_y=0, roi=whole,
        )  # fmt: skip

    def _odometry(self, stamp_ns: int, pose: Odometry) -> None:
        half = pose.heading_rad / 2.0
        place, turn = (pose.x_m, pose.y_m), (0.0, 0.0, math.sin(half), math.cos(half))
        at = self._of(
            "geometry_msgs/msg/Pose", position=self._of("geometry_msgs/msg/Point", x=place[0], y=place[1], z=0.0),
            orientation=self._turn(turn),
        )  # fmt: skip
        twist = self._twist(Velocity(pose.speed_m_s, pose.turn_rate_rad_s))
        odometry = self._of(
            names.ODOMETRY, header=self._header(stamp_ns, _ODOM), child_frame_id=_BASE,
            pose=self._of("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36)),
            twist=self._of("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip
        self._write("/odom", names.ODOMETRY, stamp_ns, odometry)
        moved = self._transform(stamp_ns, (_ODOM, _BASE), place, turn)
        self._write("/tf", _TF, stamp_ns, self._of(_TF, transforms=[moved]))

    def _imu(self, stamp_ns: int, sample: ImuSample) -> None:
        absent = np.zeros(9)
        absent[0] = _ABSENT
        imu = self._of(
            _IMU, header=self._header(stamp_ns, _BASE), orientation=self._turn((0.0, 0.0, 0.0, 1.0)),
            orientation_covariance=absent, angular_velocity=self._vector(*sample.angular_velocity_rad_s),
            angular_velocity_covariance=np.zeros(9), linear_acceleration=self._vector(*sample.acceleration_m_s2),
            linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        self._write("/imu", _IMU, stamp_ns, imu)

    def _transform(
        self, stamp_ns: int, frames: tuple[str, str], place: tuple[float, float], turn: tuple[float, ...]
    ) -> Any:  # noqa: ANN401 - as above
        transform = self._of(
            "geometry_msgs/msg/Transform", translation=self._vector(*place, 0.0), rotation=self._turn(turn)
        )
        return self._of(
            "geometry_msgs/msg/TransformStamped", header=self._header(stamp_ns, frames[0]), child_frame_id=frames[1],
            transform=transform,
        )  # fmt: skip

    def _twist(self, velocity: Velocity) -> Any:  # noqa: ANN401 - as above
        ahead, turn = self._vector(velocity.linear, 0.0, 0.0), self._vector(0.0, 0.0, velocity.angular)
        return self._of("geometry_msgs/msg/Twist", linear=ahead, angular=turn)

    def _vector(self, x: float, y: float, z: float) -> Any:  # noqa: ANN401 - as above
        return self._of("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _turn(self, turn: tuple[float, ...]) -> Any:  # noqa: ANN401 - as above
        x, y, z, w = turn
        return self._of("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _header(self, stamp_ns: int, frame: str) -> Any:  # noqa: ANN401 - as above
        if not 0 <= stamp_ns < _LATEST_NS:
            raise ExportFailure(f"a time {stamp_ns / 1e9:.0f} s after 1970, which ROS cannot say")
        seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
        stamp = self._of("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_ns)
        return self._of("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _of(self, kind: str, **fields: object) -> Any:  # noqa: ANN401 - as above
        return self._store.types[kind](**fields)

    def _write(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:  # noqa: ANN401 - as above
        if topic not in self._channels:
            qos = [_latched()] if topic == "/tf_static" else []
            self._channels[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=qos
            )
        self._writer.write(self._channels[topic], stamp_ns, self._store.serialize_cdr(message, kind))


def _latched() -> Any:  # noqa: ANN401 - as above
    """Return the quality of service of what is said once, and told to whoever comes later."""
    from rosbags.interfaces import (  # noqa: PLC0415 - as above
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    for_ever = QosTime(*divmod(2**63 - 1, 1_000_000_000))
    return Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, for_ever, for_ever,
        QosLiveliness.AUTOMATIC, for_ever, avoid_ros_namespace_conventions=False,
    )  # fmt: skip
