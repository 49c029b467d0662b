"""Bags of a slow drive along the painted corridor, with the defects of real recordings."""

import math
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from services.kit.jpeg import encode_jpeg
from services.kit.ros_message import ros_message
from tests import corridor

BEGIN_S: Final = 1_700_000_000.0
PERIOD_S: Final = 0.1
SPEED: Final = 0.4  # Metres a second.
FRAMES: Final = 120
IMAGE: Final = "/camera/image/compressed"
#: Turn rates of the drive and for how many frames each, in radians per second.
LEGS: Final = ((0, 7), (0.5, 9), (0, 17), (-0.5, 12), (0, 6), (-0.5, 4), (0, 24), (0.5, 7), (0, 13))
_COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_TWIST: Final = "geometry_msgs/msg/Twist"
_INFO: Final = "sensor_msgs/msg/CameraInfo"


class Frame(NamedTuple):
    """One moment of a drive."""

    time_s: float
    pose: corridor.Pose
    linear: float
    angular: float
    jpeg: bytes


class Said(NamedTuple):
    """A message, and when the recorder received it."""

    topic: str
    kind: str
    received_s: float
    fields: dict[str, Any]


@cache
def drive() -> tuple[Frame, ...]:
    """Return a winding drive at ten frames a second."""
    frames = []
    x = y = heading = 0.0
    turns = [turn for turn, count in LEGS for _ in range(count)]
    for number in range(FRAMES):
        turn = turns[number] if number < len(turns) else -0.5
        jpeg = encode_jpeg(corridor.view(x, y, heading))
        frames.append(Frame(PERIOD_S * number, (x, y, heading), SPEED, turn, jpeg))
        middle = heading + turn * PERIOD_S / 2.0
        x += SPEED * PERIOD_S * math.cos(middle)
        y += SPEED * PERIOD_S * math.sin(middle)
        heading += turn * PERIOD_S
    return tuple(frames)


def since(frames: Iterable[Frame], begin: Frame) -> list[Frame]:
    """Return frames with poses as of an odometry that was reset at a frame."""
    x, y, heading = begin.pose
    cos = math.cos(heading)
    sin = math.sin(heading)
    return [
        frame._replace(
            pose=(
                cos * (frame.pose[0] - x) + sin * (frame.pose[1] - y),
                -sin * (frame.pose[0] - x) + cos * (frame.pose[1] - y),
                frame.pose[2] - heading,
            )
        )
        for frame in frames
    ]


def header(time_s: float, frame: str = "") -> dict[str, Any]:
    """Return the header of a message."""
    stamp_ns = round(time_s * 1e9)
    stamp = {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}
    return {"stamp": stamp, "frame_id": frame}


def image(frame: Frame, topic: str = IMAGE, late_s: float = 0.0, stamp_s: float = -1.0) -> Said:
    """Return an image that arrives late; its time of capture is right without a stamp."""
    time_s = BEGIN_S + frame.time_s
    data = np.frombuffer(frame.jpeg, np.uint8)
    fields = {"format": "jpeg", "data": data}
    fields["header"] = header(time_s if stamp_s < 0.0 else stamp_s, "camera")
    return Said(topic, _COMPRESSED, time_s + late_s, fields)


def odometry(frame: Frame, topic: str = "/odom", **changes: Any) -> Said:
    """Return a pose and its twist."""
    x, y, heading = frame.pose
    turn = {"z": math.sin(heading / 2.0), "w": math.cos(heading / 2.0)}
    pose = {"position": {"x": x, "y": y}, "orientation": turn} | changes
    twist = {"linear": {"x": frame.linear}, "angular": {"z": frame.angular}}
    time_s = BEGIN_S + frame.time_s
    fields = {"header": header(time_s), "pose": {"pose": pose}, "twist": {"twist": twist}}
    return Said(topic, _ODOMETRY, time_s + 0.001, fields)


def command(frame: Frame, topic: str = "/cmd_vel", aside: float = 0.0) -> Said:
    """Return a command."""
    twist = {"linear": {"x": frame.linear, "y": aside}, "angular": {"z": frame.angular}}
    return Said(topic, _TWIST, BEGIN_S + frame.time_s + 0.002, twist)


def calibration(topic: str) -> Said:
    """Return the calibration of a camera of 45 pixels focal length."""
    k = [45.0, 0.0, 32.0, 0.0, 45.0, 24.0, 0.0, 0.0, 1.0]
    fields = {"header": header(BEGIN_S, "camera"), "height": 48, "width": 64, "k": k}
    return Said(topic, _INFO, BEGIN_S, fields)


def said(
    frames: Iterable[Frame] | None = None, *, commands: bool = True, poses: bool = True
) -> list[Said]:
    """Return the messages of frames in the order of reception."""
    found = []
    for frame in drive() if frames is None else frames:
        found.append(image(frame))
        found += [odometry(frame)] if poses else []
        found += [command(frame)] if commands else []
    return found


def write(path: Path, messages: Iterable[Said], *, ros1: bool = False, sort: bool = True) -> Path:
    """Write a bag of ROS 2, or a file of ROS 1, with messages by their time of reception."""
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - of the extra `formats`
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    encode = store.serialize_ros1 if ros1 else store.serialize_cdr
    plugin = rosbag2.StoragePlugin.SQLITE3
    writer = (
        rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    )
    channels: dict[str, Any] = {}
    ordered = sorted(messages, key=lambda one: one.received_s) if sort else messages
    with writer:
        for topic, kind, received_s, fields in ordered:
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=store)
            data = encode(ros_message(store, kind, fields), kind)
            writer.write(channels[topic], round(received_s * 1e9), data)
    return path


def old(folder: Path) -> Path:
    """Write a folder with a short bag of ROS 1."""
    folder.mkdir(parents=True)
    write(folder / "old.bag", said(drive()[:8]), ros1=True)
    return folder
