"""Bags of ROS 2, MCAP or SQLite: a folder or a bare file; times are those at which the bag received a message.

Types are those that ROS prescribes, not what a bag says of them. The command says what the driver wanted and makes the
atoms; odometry, where it is there, says where the robot was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Final

from schemas.codec import printable
from services.importers.bag_files import Received, received
from services.importers.drive import (
    LEAST_FOCAL,
    MOST_FOCAL,
    MOST_SAMPLES,
    Drive,
    Frame,
    ImportFailure,
    Motion,
    NotAnImage,
    Source,
    Tally,
    Track,
)
from services.importers.images import as_jpeg, raw_as_jpeg
from services.importers.inside import Inside
from services.importers.source_options import Wishes
from services.kit.raw_image import ENCODINGS, rgb_of

COMPRESSED, _RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
_TWIST, STAMPED, ODOMETRY = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
INFO: Final = "sensor_msgs/msg/CameraInfo"
_IMAGES: Final = (COMPRESSED, _RAW)
_COMMANDS: Final = (_TWIST, STAMPED)
#: What a velocity topic is called nearly everywhere.
_USUAL_COMMAND: Final = "cmd_vel"

Sample = tuple[float, float, float]


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
    """What the topics of a bag have: everything but the images, which are only counted."""

    images: dict[str, int] = field(default_factory=dict)
    velocities: dict[str, list[Sample]] = field(default_factory=dict)
    tracks: dict[str, list[tuple[float, float, float, float]]] = field(default_factory=dict)
    focal: dict[str, float] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)

    def take(self, message: Received) -> None:
        """Take one message; ValueError where it is none of its type."""
        if message.type in _IMAGES:
            self.images[message.topic] = self.images.get(message.topic, 0) + 1
        elif message.type in _COMMANDS:
            twist = _decoded(message)
            twist = twist.twist if message.type == STAMPED else twist
            self._velocity(message, twist)
        elif message.type == ODOMETRY:
            odometry = _decoded(message)
            self._velocity(message, odometry.twist.twist)
            place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
            yaw = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z))
            self.tracks.setdefault(message.topic, []).append((message.time_s, place.x, place.y, yaw))
        elif message.type == INFO and message.topic not in self.focal:
            info = _decoded(message)
            focal = float(info.k[0]) / max(info.width, 1)
            if not LEAST_FOCAL <= focal <= MOST_FOCAL:
                raise ValueError("no camera sees so")
            self.focal[message.topic] = focal
        else:
            self.others[message.topic] = message.type

    def _velocity(self, message: Received, twist: Any) -> None:  # noqa: ANN401 - as above
        samples = self.velocities.setdefault(message.topic, [])
        if len(samples) >= MOST_SAMPLES:
            raise ImportFailure(f"{message.topic}: more than {MOST_SAMPLES} messages")
        samples.append((message.time_s, float(twist.linear.x), float(twist.angular.z)))


def read(inside: Inside, wishes: Wishes, tally: Tally) -> Source:
    """Read a bag; it is one drive."""
    typestore()
    found = _Found()
    for message in received(inside, tally):
        try:
            found.take(message)
        except ValueError:
            tally.count(f"messages of {message.topic} are not what their type says")
    image = _chosen("image (CompressedImage or Image)", "--camera", wishes.camera, list(found.images), inside, found)
    velocity = _chosen(
        "velocity (Twist, TwistStamped or Odometry)", "--velocity", wishes.velocity, _velocities(found), inside, found
    )
    scale = wishes.speed or 1.0, wishes.turn_rate or 1.0
    rows = [(time_s, scale[0] * linear, scale[1] * angular) for time_s, linear, angular in found.velocities[velocity]]
    tracked = velocity if velocity in found.tracks else _only(found.tracks)
    if tracked is not None:
        tally.say(f"odometry is that of {printable(tracked)}")
    tally.say(f"images are those of {printable(image)}, velocities those of {printable(velocity)}")
    drive = Drive(
        inside.path.stem,
        Motion.of(rows, tally),
        partial(_frames, inside, image),
        found.images[image],
        None if tracked is None else Track.of(found.tracks[tracked], tally),
        focal=_focal(image, found.focal),
    )
    return Source([drive], metric=True)


def _velocities(found: _Found) -> list[str]:
    """Return the topics that can be meant: commands, or else odometry; of several the one with the usual name."""
    commands = [topic for topic in found.velocities if topic not in found.tracks]
    usual = [topic for topic in commands if topic.rpartition("/")[2] == _USUAL_COMMAND]
    return usual if len(usual) == 1 else commands or list(found.tracks)


def _only(tracks: dict[str, Any]) -> str | None:
    usual = [topic for topic in tracks if topic.rpartition("/")[2] == "odom"]
    return next(iter(usual if len(usual) == 1 else tracks if len(tracks) == 1 else []), None)


def _chosen(what: str, flag: str, wish: str | None, topics: list[str], inside: Inside, found: _Found) -> str:
    if wish is not None:
        known = found.images if flag == "--camera" else found.velocities
        if wish not in known:
            raise ImportFailure(f"{inside.path}: no topic {wish} of {what}; there are: {_list(list(known))}")
        return wish
    if not topics:
        every = {**found.others, **dict.fromkeys([*found.images, *found.velocities], "")}
        raise ImportFailure(f"{inside.path}: no topic of {what}; it has: {_list(list(every))}")
    if len(topics) > 1:
        raise ImportFailure(f"{inside.path}: several topics of {what}: {_list(topics)}; choose one with {flag}")
    return topics[0]


def _list(topics: list[str]) -> str:
    return printable(", ".join(topics[:10])) or "none"


def _focal(image: str, focal: dict[str, float]) -> float | None:
    """Return the focal length of the camera beside the images: /camera/camera_info of /camera/image."""
    of = [topic for topic in focal if topic.rpartition("/")[0] and image.startswith(topic.rpartition("/")[0] + "/")]
    return focal[of[0]] if len(of) == 1 else None


def _frames(inside: Inside, topic: str) -> Iterator[Frame]:
    for message in received(inside, Tally(), topic):
        yield Frame(message.time_s, partial(_READ[message.type], message))


def _compressed(message: Received) -> bytes:
    return as_jpeg(bytes(_image(message).data))


def _raw(message: Received) -> bytes:
    image = _image(message)
    if image.encoding not in ENCODINGS:
        raise NotAnImage("images have an encoding that is not read (8 bits of RGB, BGR, grey or YUV 4:2:2 are)")
    try:
        return raw_as_jpeg(rgb_of(image.encoding, image.width, image.height, image.step, image.data))
    except ValueError as error:
        raise error if isinstance(error, NotAnImage) else NotAnImage("images are damaged") from None


def _image(message: Received) -> Any:  # noqa: ANN401 - as above
    try:
        return _decoded(message)
    except ValueError:
        raise NotAnImage("images are damaged") from None


_READ: Final[dict[str, Callable[[Received], bytes]]] = {COMPRESSED: _compressed, _RAW: _raw}
