"""Bags of ROS 2, MCAP or SQLite: a folder or a file; times are those of reception.

Types are those of ROS, not the definitions in a bag. The driver's command determines the actions;
odometry, if any, gives the pose. Our own MCAP reader tolerates damage.
"""

import math
import re
import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable
from services.importers.drive import (
    MOST_SAMPLES,
    Image,
    ImportedDrive,
    ImportFailure,
    NotAnImage,
    Tally,
)
from services.importers.images import ros_as_jpeg
from services.importers.inside import Inside
from services.importers.job import ImportJob
from services.kit.cameras import camera_of_ros
from services.recordings.records import MAGIC, mapped, records
from smal.camera import Camera

_SUFFIXES: Final = (".mcap", ".db3")
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
#: Largest message: a raw image of 4096x3072x4 and its header.
_MOST_BYTES: Final = 4 * 4096 * 3072 + 2**20
#: Bytes of a row beside its blob: two lengths, and a header of at least three columns.
_LEAST_ROW: Final = 6
COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"
TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
INFO: Final = "sensor_msgs/msg/CameraInfo"


class Received(NamedTuple):
    """One message of a bag."""

    topic: str
    type: str
    time_s: float
    data: bytes


def received(inside: Inside, tally: Tally, topic: str | None = None) -> Iterator[Received]:
    """Yield the messages of a bag, of one topic or all; ImportFailure if it is damaged."""
    for name in _files(inside):
        path = inside.regular(name)
        messages = _of_sqlite(path, tally) if path.suffix == ".db3" else _of_mcap(path, tally)
        try:
            for message in messages:
                if topic in (None, message.topic):
                    yield message._replace(data=_unpacked(message.data))
        except (
            McapError,
            struct.error,
            ValueError,
            sqlite3.Error,
            MemoryError,
            OverflowError,
        ) as error:
            reason = printable(str(error)) or type(error).__name__
            raise ImportFailure(f"{inside.called(name)}: damaged: {reason}") from None


def _files(inside: Inside) -> list[str]:
    if not inside.is_folder:
        if inside.path.suffix not in _SUFFIXES:
            raise ImportFailure(f"{inside.path}: not a bag (a folder, or a file *.mcap or *.db3)")
        return [""]
    names = inside.names()
    found = sorted((name for name in names if name.endswith(_SUFFIXES)), key=_by_number)
    if not found:
        bags = [name for name in names if "metadata.yaml" in inside.names(name)]
        more = [f"; {printable(name)} in it is a bag: import each bag separately" for name in bags]
        more += [
            f"; unpack {printable(name)} first: zstd -d" for name in names if name.endswith(".zstd")
        ]
        raise ImportFailure(f"{inside.path}: no *.mcap or *.db3 in this folder{[*more, ''][0]}")
    return found


def _by_number(name: str) -> tuple[int, str]:
    """Sort ``bag_10`` after ``bag_9``."""
    number = re.search(r"_(\d{1,9})\.\w+$", name)
    return int(number[1]) if number else 0, name


def _of_mcap(path: Path, tally: Tally) -> Iterator[Received]:
    data = mapped(path)
    if data[: len(MAGIC)] != MAGIC:
        raise McapError("not an MCAP file")
    if data[-len(MAGIC) :] != MAGIC:
        tally.say(f"{printable(path.name)}: end missing; only complete messages are read")
    types: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    for record in records(data):
        if isinstance(record, Schema):
            types[record.id] = record.name
        elif isinstance(record, Channel):
            if _is_cdr(record.message_encoding, tally):
                channels[record.id] = record.topic, types.get(record.schema_id, "")
        elif isinstance(record, Message) and record.channel_id in channels:
            yield Received(*channels[record.channel_id], record.log_time / 1e9, record.data)


def _of_sqlite(path: Path, tally: Tally) -> Iterator[Received]:
    with closing(
        sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    ) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
        database.execute("PRAGMA trusted_schema = OFF")
        for table in ("topics", "messages"):
            _check_plain(database, table)
        topics: dict[Any, tuple[str, str]] = {}
        for number, name, kind, form in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            if _is_cdr(form, tally):
                topics[number] = str(name), str(kind)
        # In the order of reception, because sorting by time can need as much memory as the
        # messages.
        left = path.stat().st_size
        for number, stamp_ns, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
        ):
            left -= _LEAST_ROW + (len(data) if isinstance(data, bytes) else 0)
            if left < 0:
                raise sqlite3.DatabaseError("its messages are larger than the file")
            if number in topics and isinstance(data, bytes) and isinstance(stamp_ns, int):
                yield Received(*topics[number], stamp_ns / 1e9, data)


def _check_plain(database: sqlite3.Connection, table: str) -> None:
    """Reject a view, a virtual table or a generated column, which can compute forever."""
    found = database.execute(
        "SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,)
    ).fetchall()
    if (
        len(found) != 1 or found[0][0] != "table" or not found[0][1]
    ):  # A virtual table has no page of its own.
        raise sqlite3.DatabaseError("tables of topics and messages not found")
    for name, hidden in database.execute(
        "SELECT name, hidden FROM pragma_table_xinfo(?)", (table,)
    ):
        if hidden:
            raise sqlite3.DatabaseError(f"the column {name} of {table} is computed, not stored")


def _is_cdr(encoding: object, tally: Tally) -> bool:
    tally.count(
        f"unsupported encoding {encoding or '(empty)'} of topics, not ROS 2's CDR",
        int(encoding != "cdr"),
    )
    return encoding == "cdr"


def _unpacked(data: bytes | memoryview) -> bytes:
    """Return the bytes of a message, unpacked within a limit."""
    whole = bytes(data)
    if not whole.startswith(_ZSTD):
        return whole
    try:
        unpacked: bytes = ZstdDecompressor().stream_reader(whole).read(_MOST_BYTES + 1)
    except ZstdError as error:
        raise ValueError(f"invalid packed message: {error}") from None
    if len(unpacked) > _MOST_BYTES:
        raise ValueError(f"packed message too large (more than {_MOST_BYTES} bytes)")
    return unpacked


@cache
def typestore() -> Any:  # noqa: ANN401 - of a package that may be missing
    """Return the types of ROS messages."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - of the extra `formats`

    # The used types are equal in every distribution from Foxy on.
    return get_typestore(Stores.ROS2_JAZZY)


def _decoded(message: Received) -> Any:  # noqa: ANN401 - as above
    """Decode a message; ValueError if its bytes do not fit its type."""
    try:
        return typestore().deserialize_cdr(message.data, message.type)
    except Exception as error:  # noqa: BLE001
        # rosbags raises many exceptions for malformed bytes.
        raise ValueError(type(error).__name__) from None


class _Option(NamedTuple):
    """An option that chooses a topic."""

    flag: str
    what: str


_CAMERA: Final = _Option("--camera", "image (CompressedImage or Image)")
_VELOCITY: Final = _Option("--velocity", "velocity (Twist, TwistStamped or Odometry)")


@dataclass
class _Found:
    """The messages of a bag by topic; of images only the times."""

    path: Path
    images: dict[str, list[float]] = field(default_factory=dict)
    velocities: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    tracks: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)

    def take(self, message: Received) -> None:
        """Add a message; ValueError if it does not fit its type."""
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
            place = odometry.pose.pose.position
            turn = odometry.pose.pose.orientation
            yaw = math.atan2(
                2.0 * (turn.w * turn.z + turn.x * turn.y),
                1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z),
            )
            _keep(self.tracks, topic, (time_s, place.x, place.y, yaw))
        elif kind == INFO and topic not in self.cameras:
            self.cameras[topic] = camera_of_ros(_decoded(message))

    def image_topic(self, wish: str | None) -> str:
        images = list(self.images)
        return self._chosen(_CAMERA, wish, images, images)

    def velocity_topic(self, wish: str | None) -> str:
        commands = [topic for topic in self.velocities if topic not in self.tracks]
        usual = _called(commands, "cmd_vel") or commands or list(self.tracks)
        return self._chosen(_VELOCITY, wish, usual, list(self.velocities))

    def track_topic(self, velocity: str) -> str | None:
        """Return the topic of odometry; None if there is no or more than one such topic."""
        if velocity in self.tracks:
            return velocity
        tracks = _called(self.tracks, "odom") or list(self.tracks)
        return tracks[0] if len(tracks) == 1 else None

    def camera_beside(self, image: str) -> Camera | None:
        """Return the camera of ``/camera/camera_info`` for the images of ``/camera/image``."""
        folders = [topic.rpartition("/")[0] for topic in self.cameras]
        beside = [
            camera
            for folder, camera in zip(folders, self.cameras.values(), strict=True)
            if folder and image.startswith(f"{folder}/")
        ]
        return beside[0] if len(beside) == 1 else None

    def _chosen(self, option: _Option, wish: str | None, usual: list[str], known: list[str]) -> str:
        """Return the requested topic, or the only usual topic."""
        if wish in known:
            return wish
        if wish is not None:
            wrong = f"topic {wish} of {option.what} not found; choose from {_list(known)}"
        elif not usual:
            wrong = f"topic of {option.what} not found among {_list(sorted(self.topics))}"
        elif len(usual) > 1:
            wrong = (
                f"several topics of {option.what}: {_list(usual)}; choose one with {option.flag}"
            )
        else:
            return usual[0]
        raise ImportFailure(f"{self.path}: {wrong}")

    def _velocity(self, message: Received, twist: Any) -> None:  # noqa: ANN401 - as above
        _keep(
            self.velocities,
            message.topic,
            (message.time_s, float(twist.linear.x), float(twist.angular.z)),
        )


def _keep(kept: dict[str, list[Any]], topic: str, sample: Any) -> None:  # noqa: ANN401 - a time, or a tuple with one
    samples = kept.setdefault(topic, [])
    if len(samples) >= MOST_SAMPLES:
        raise ImportFailure(f"{printable(topic)}: too large (more than {MOST_SAMPLES} messages)")
    samples.append(sample)


def found(inside: Inside) -> bool:
    """Return whether a file is a bag, or a folder has bags."""
    names = inside.names() if inside.is_folder else [inside.path.name]
    return any(name.endswith(_SUFFIXES) for name in names)


def read(inside: Inside, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    """Read a bag as one drive."""
    typestore()
    found = _Found(inside.path)
    for message in received(inside, tally):
        try:
            found.take(message)
        except ValueError:
            tally.count(f"messages of {message.topic} do not match their type")
    image = found.image_topic(job.camera)
    velocity = found.velocity_topic(job.velocity)
    track = found.track_topic(velocity)
    if track is not None:
        tally.say(f"odometry from {printable(track)}")
    tally.say(f"images from {printable(image)}, velocities from {printable(velocity)}")

    def images() -> Iterator[Image]:
        return (partial(_image, message, tally) for message in received(inside, Tally(), image))

    return [
        ImportedDrive.of_rows(
            inside.path.stem,
            np.array(found.images[image]),
            images,
            np.array(found.velocities[velocity]) * (1.0, job.speed or 1.0, job.turn_rate or 1.0),
            [] if track is None else found.tracks[track],
            tally,
            camera=found.camera_beside(image),
        )
    ]


def _called(topics: Collection[str], usual: str) -> list[str]:
    """Return the topic with the usual name, if there is exactly one."""
    found = [topic for topic in topics if topic.rpartition("/")[2] == usual]
    return found if len(found) == 1 else []


def _list(topics: Collection[str]) -> str:
    return printable(", ".join(list(topics)[:10])) or "none"


def _image(message: Received, tally: Tally) -> bytes:
    try:
        image = _decoded(message)
    except ValueError:
        raise NotAnImage("images are damaged") from None
    return ros_as_jpeg(image, tally)
