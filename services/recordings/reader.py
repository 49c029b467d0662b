"""Reads recordings back: for each episode what the camera saw and what the actuator did, tick by tick.

Pure of Zenoh. Files may be truncated (their whole messages are read) and may hold several episodes (each stays by
itself).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mcap.exceptions import McapError
from mcap.records import Channel, McapRecord
from mcap.records import Message as StoredMessage
from pydantic import ValidationError

from schemas.base import EPISODE_ID_PATTERN, ROBOT_ID_PATTERN, Message
from schemas.camera_info import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.observation import Observation
from schemas.odometry import Odometry
from schemas.pose import Pose
from schemas.topics import APPLIED, CAMERA, CAMERA_INFO, EPISODE, JPEG, OBSERVATION, ODOMETRY, POSE, Topic, topic_of
from services.recordings.recorded import RecordedEpisode
from services.recordings.records import MAGIC, Allowance, MemoryLimitError, mapped, records
from services.recordings.sink import PARTIAL_SUFFIX, is_being_recorded

#: Where images are; recordings of older versions have them, as JPEG too, on the key of the raw ones.
IMAGES: Final = (JPEG, CAMERA)


#: Memory that a message takes beside its bytes, which may be few: its object, the numbers in it, and its place.
_OBJECTS: Final = 2048


class RecordingError(Exception):
    """A file cannot be used as a recording; the text names it and says why in one line."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a file holds.

    Attributes
    ----------
    path
        The file.
    episodes
        In order of appearance.
    truncated
        Whether the end of the file is missing.
    bad
        Messages that are not what their topic says; they were left out.
    """

    path: Path
    episodes: tuple[RecordedEpisode, ...]
    truncated: bool
    bad: int

    def remarks(self) -> Iterator[str]:
        """Yield one line for everything that is not as it should be."""
        if self.truncated:
            yield f"{self.path}: truncated; the {sum(one.frames for one in self.episodes)} whole frames are read"
        if self.bad:
            yield f"{self.path}: {self.bad} malformed messages are left out"


def read_recording(
    path: Path,
    fingerprint: str | None = None,
    allowance: Allowance | None = None,
    keep: Collection[Topic] = (),
    topics: Collection[Topic] | None = None,
) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path
        An MCAP file, sealed or left behind.
    fingerprint
        Which feature vectors to take from the observations; none of them if not given.
    allowance
        For the memory that it takes; one of its own if not given.
    keep
        Topics whose messages are kept as they are, too.
    topics
        Read only these, and the events of episodes; all if not given.

    Raises
    ------
    RecordingError
        When the file cannot be read, is no MCAP file, holds no episode or no frame, is still being recorded, or takes
        too much memory.
    """
    if being_recorded(path):
        raise RecordingError(f"{path}: still being recorded; end the episode or stop the recorder first")
    data = open_recording(path)
    allowance = allowance or Allowance()
    before = allowance.left
    reader = _Reader(fingerprint, allowance, keep, topics)
    try:
        for record in records(data, allowance):
            reader.take(record)
    except MemoryLimitError as error:
        # It is left out, and what it took is free again.
        allowance.left = before
        raise RecordingError(f"{path}: {error}; unpack it first (mcap decompress), or read fewer at once") from None
    except (McapError, ValueError, struct.error) as error:
        raise RecordingError(f"{path}: damaged: {str(error) or type(error).__name__}") from None
    episodes = tuple(episode for episode in reader.episodes.values() if episode.purpose is not None)
    if not episodes:
        raise RecordingError(f"{path}: holds no episode")
    if not any(episode.frames for episode in episodes):
        raise RecordingError(f"{path}: holds no camera frame")
    truncated = len(data) < 2 * len(MAGIC) or data[-len(MAGIC) :] != MAGIC
    return Recording(path, episodes, truncated, reader.bad)


def being_recorded(path: Path) -> bool:
    """Whether a living recorder writes this recording.

    Raises
    ------
    RecordingError
        When it cannot be read.
    """
    try:
        return path.suffix == PARTIAL_SUFFIX and is_being_recorded(path)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def open_recording(path: Path) -> memoryview:
    """Return the bytes of a recording.

    Raises
    ------
    RecordingError
        When it cannot be read, or is no MCAP file.
    """
    try:
        data = mapped(path)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    if not data:
        raise RecordingError(f"{path}: empty")
    if data[: len(MAGIC)] != MAGIC:
        raise RecordingError(f"{path}: not an MCAP file")
    return data


class _Reader:
    """Sorts the records of a file into episodes."""

    def __init__(
        self,
        fingerprint: str | None,
        allowance: Allowance,
        keep: Collection[Topic],
        topics: Collection[Topic] | None,
    ) -> None:
        self._wanted = None if topics is None else {EPISODE.name, *(topic.name for topic in topics)}
        self._allowance = allowance
        self.episodes: dict[tuple[str, str], RecordedEpisode] = {}
        self.bad = 0
        self._fingerprint = fingerprint
        self._keep = {topic.name for topic in keep}
        self._channels: dict[int, tuple[Topic, str, str]] = {}
        self._take: dict[str, Callable[[RecordedEpisode, Message], None]] = {
            EPISODE.name: self._take_event,
            OBSERVATION.name: self._take_observation,
            APPLIED.name: self._take_applied,
            POSE.name: self._take_pose,
            ODOMETRY.name: self._take_odometry,
            CAMERA_INFO.name: self._take_camera_info,
        }

    def take(self, record: McapRecord) -> None:
        """Take one record."""
        if isinstance(record, Channel):
            self._take_channel(record)
        elif isinstance(record, StoredMessage) and record.channel_id in self._channels:
            self._take_message(*self._channels[record.channel_id], record.sequence, memoryview(record.data))

    def _take_channel(self, channel: Channel) -> None:
        topic = topic_of(channel.topic)
        if topic is not None and self._wanted is not None and topic.name not in self._wanted:
            topic = None
        robot, episode = channel.metadata.get("robot"), channel.metadata.get("episode")
        # Anything else in the file is other people's.
        if topic is not None and _is_id(ROBOT_ID_PATTERN, robot) and _is_id(EPISODE_ID_PATTERN, episode):
            self._channels[channel.id] = (topic, str(robot), str(episode))
        else:
            self._channels.pop(channel.id, None)

    def _take_message(self, topic: Topic, robot: str, episode: str, tick: int, payload: memoryview) -> None:
        self._allowance.take(_OBJECTS)
        record = self.episodes.setdefault((robot, episode), RecordedEpisode(robot, episode))
        if topic in IMAGES:
            record.images.setdefault(tick, payload)
            return
        take = self._take.get(topic.name)
        if take is None and topic.name not in self._keep:
            return
        try:
            message = topic.message.model_validate_json(bytes(payload))
        except ValidationError:
            self.bad += 1
            return
        if (message.robot, message.episode) != (robot, episode):
            self.bad += 1
            return
        if topic.name in self._keep:
            record.kept.setdefault(topic.name, {}).setdefault(message.tick, message)
        if take is not None:
            take(record, message)

    def _take_event(self, record: RecordedEpisode, event: Message) -> None:
        assert isinstance(event, Episode)  # noqa: S101 - by the table of topics
        record.world, record.seed, record.purpose, record.driver = event.world, event.seed, event.purpose, event.driver
        record.goal = event.goal
        if event.event == "ended":
            record.outcome, record.end_tick = event.outcome, event.tick

    def _take_observation(self, record: RecordedEpisode, observation: Message) -> None:
        assert isinstance(observation, Observation)  # noqa: S101 - by the table of topics
        if observation.fingerprint == self._fingerprint and observation.tick not in record.features:
            record.features[observation.tick] = observation.features.to_numpy()

    def _take_applied(self, record: RecordedEpisode, applied: Message) -> None:
        assert isinstance(applied, CommandApplied)  # noqa: S101 - by the table of topics
        # Several in one tick: the last is what moved the robot on to the next frame.
        last = record.applied.get(applied.tick)
        if last is None or applied.sequence > last.sequence:
            record.applied[applied.tick] = applied

    def _take_pose(self, record: RecordedEpisode, pose: Message) -> None:
        assert isinstance(pose, Pose)  # noqa: S101 - by the table of topics
        record.poses.setdefault(pose.tick, pose)

    def _take_odometry(self, record: RecordedEpisode, odometry: Message) -> None:
        assert isinstance(odometry, Odometry)  # noqa: S101 - by the table of topics
        record.odometry.setdefault(odometry.tick, (odometry.x_m, odometry.y_m, odometry.heading_rad))

    def _take_camera_info(self, record: RecordedEpisode, info: Message) -> None:
        assert isinstance(info, CameraInfo)  # noqa: S101 - by the table of topics
        record.focal = info.focal_px / info.width


def _is_id(pattern: str, text: str | None) -> bool:
    return text is not None and re.fullmatch(pattern, text) is not None
