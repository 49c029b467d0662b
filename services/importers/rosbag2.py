"""Bags of ROS 2, MCAP or SQLite: a folder or a bare file; times are those at which the bag received a message.

Types are those that ROS prescribes, not what a bag says of them. The command says what the driver wanted and makes the
atoms; odometry, where it is there, says where the robot was.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.importers.bag_files import Received, received
from services.importers.drive import MOST_SAMPLES, Drive, Image, ImportFailure, NotAnImage, Tally
from services.importers.images import as_jpeg, raw_as_jpeg
from services.importers.inside import Inside
from services.importers.job import Job
from services.kit.cameras import camera_of_ros
from services.kit.raw_image import ENCODINGS, rgb_of
from smal.camera import Camera

COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
TWIST, STAMPED, ODOMETRY = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
INFO: Final = "sensor_msgs/msg/CameraInfo"


@cache
def typestore() -> Any:  # noqa: ANN401 - of a package that may be missing
    """Return the types of ROS messages."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - of the extra `formats`

    # The types read and written here are the same in every distribution from Foxy on.
    return get_typestore(Stores.ROS2_JAZZY)


def _decoded(message: Received) -> Any:  # noqa: ANN401 - as above
    """Return a message of a type that is known here; ValueError where its bytes are none."""
    try:
        return typestore().deserialize_cdr(message.data, message.type)
    except Exception as error:  # noqa: BLE001
        # What rosbags raises for bytes that are no message is many things, none of them its caller's business.
        raise ValueError(type(error).__name__) from None


@dataclass
class _Found:
    """What a bag has, by topic: everything but the images, of which only the times are kept."""

    images: dict[str, list[float]] = field(default_factory=dict)
    velocities: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    tracks: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)

    def take(self, message: Received) -> None:
        """Take one message; ValueError where it is none of its type."""
        topic, kind, time_s, _ = message
        self.topics.add(topic)
        if kind in (COMPRESSED, RAW):
            _keep(self.images, topic, time_s)
        elif kind == TWIST:
            self._velocity(message, _decoded(message))
        elif kind == STAMPED:
            self._velocity(message, _decoded(message).twist)
        elif kind == ODOMETRY:
            odometry = _decoded(message)
            self._velocity(message, odometry.twist.twist)
            place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
            yaw = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z))
            _keep(self.tracks, topic, (time_s, place.x, place.y, yaw))
        elif kind == INFO and topic not in self.cameras:
            self.cameras[topic] = camera_of_ros(_decoded(message))

    def _velocity(self, message: Received, twist: Any) -> None:  # noqa: ANN401 - as above
        _keep(self.velocities, message.topic, (message.time_s, float(twist.linear.x), float(twist.angular.z)))


def _keep(kept: dict[str, list[Any]], topic: str, sample: Any) -> None:  # noqa: ANN401 - a time, or a tuple with one
    samples = kept.setdefault(topic, [])
    if len(samples) >= MOST_SAMPLES:
        raise ImportFailure(f"{printable(topic)}: more than {MOST_SAMPLES} messages")
    samples.append(sample)


def read(inside: Inside, job: Job, tally: Tally) -> list[Drive]:
    """Read a bag; it is one drive."""
    typestore()
    found = _Found()
    for message in received(inside, tally):
        try:
            found.take(message)
        except ValueError:
            tally.count(f"messages of {message.topic} are not what their type says")
    commands = [topic for topic in found.velocities if topic not in found.tracks]
    meant = _called(commands, "cmd_vel") or commands or list(found.tracks)
    image = _chosen("image (CompressedImage or Image)", "--camera", job.camera, list(found.images), found, inside)
    velocity = _chosen("velocity (Twist, TwistStamped or Odometry)", "--velocity", job.velocity, meant, found, inside)
    tracks = [velocity] if velocity in found.tracks else _called(found.tracks, "odom") or list(found.tracks)
    if len(tracks) == 1:
        tally.say(f"odometry is that of {printable(tracks[0])}")
    tally.say(f"images are those of {printable(image)}, velocities those of {printable(velocity)}")
    rows = np.array(found.velocities[velocity]) * (1.0, job.speed or 1.0, job.turn_rate or 1.0)
    # The camera beside the images: /camera/camera_info of /camera/image.
    beside = [topic for topic in found.cameras if (at := topic.rpartition("/")[0]) and image.startswith(f"{at}/")]
    camera = found.cameras[beside[0]] if len(beside) == 1 else None
    way = found.tracks[tracks[0]] if len(tracks) == 1 else []

    def images() -> Iterator[Image]:
        return (partial(_image, message) for message in received(inside, Tally(), image))

    times_s = np.array(found.images[image])
    return [Drive.of_rows(inside.path.stem, times_s, images, rows, way, tally, camera=camera)]


def _called(topics: Collection[str], usual: str) -> list[str]:
    """Return the topic that has the usual name; none where several have."""
    found = [topic for topic in topics if topic.rpartition("/")[2] == usual]
    return found if len(found) == 1 else []


def _chosen(what: str, flag: str, wish: str | None, topics: list[str], found: _Found, inside: Inside) -> str:
    """Return the topic that is wished for, or the only one."""
    if wish is not None:
        known = found.images if flag == "--camera" else found.velocities
        if wish not in known:
            raise ImportFailure(f"{inside.path}: no topic {wish} of {what}; there are: {_list(known)}")
        return wish
    if not topics:
        raise ImportFailure(f"{inside.path}: no topic of {what}; it has: {_list(sorted(found.topics))}")
    if len(topics) > 1:
        raise ImportFailure(f"{inside.path}: several topics of {what}: {_list(topics)}; choose one with {flag}")
    return topics[0]


def _list(topics: Collection[str]) -> str:
    return printable(", ".join(list(topics)[:10])) or "none"


def _image(message: Received) -> bytes:
    try:
        image = _decoded(message)
        if message.type == COMPRESSED:
            return as_jpeg(bytes(image.data))
        if image.encoding not in ENCODINGS:
            raise NotAnImage("images have an encoding that is not read (8 bits of RGB, BGR, grey or YUV 4:2:2 are)")
        return raw_as_jpeg(rgb_of(image.encoding, image.width, image.height, image.step, image.data))
    except ValueError as error:
        raise error if isinstance(error, NotAnImage) else NotAnImage("images are damaged") from None
