"""Reads recordings back, also truncated ones: for each episode what camera and actuator did, tick by tick."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from schemas.base import Message
from schemas.camera_info import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.imu import Imu
from schemas.observation import Observation
from schemas.odometry import Odometry
from schemas.pose import Pose
from schemas.topics import APPLIED, CAMERA_INFO, EPISODE, JPEG, OBSERVATION, ODOMETRY, POSE, Topic
from services.recordings.recorded import RecordedEpisode
from services.recordings.records import MAGIC, UNREADABLE, Allowance, MemoryLimitError, records
from services.recordings.stream import OBJECTS, RecordingError, messages, open_recording

#: What teaching takes, and what is drawn of it.
USUAL: Final = (JPEG, CAMERA_INFO, ODOMETRY, POSE, OBSERVATION, APPLIED)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a file holds."""

    path: Path
    episodes: tuple[RecordedEpisode, ...]  # In order of appearance.
    truncated: bool  # Whether the end of the file is missing.
    bad: int  # Messages that are not what their topic says; they were left out.

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
    topics: Collection[Topic] = USUAL,
) -> Recording:
    """Read a recording, sealed or left behind: the events of episodes, and some topics, within an ``allowance``.

    Feature vectors are taken with one ``fingerprint``, or none. RecordingError where the file cannot be read, is no
    MCAP file, holds no episode or no frame, is being recorded, or takes too much memory.
    """
    data = open_recording(path)
    allowance = allowance or Allowance()
    before = allowance.left
    wanted = {EPISODE.name, *(topic.name for topic in topics)}
    found: dict[tuple[str, str], RecordedEpisode] = {}
    bad = 0
    try:
        for stored in messages(records(data, allowance)):
            if stored.topic is None or stored.topic.name not in wanted:
                continue
            allowance.take(OBJECTS)
            ids = stored.robot, stored.episode
            episode = found.setdefault(ids, RecordedEpisode(*ids))
            if stored.topic is JPEG:
                episode.images.setdefault(stored.tick, stored.payload)
                continue
            try:
                _take(episode, stored.message(), fingerprint)
            except ValueError:
                bad += 1
    except MemoryLimitError as error:
        # It is left out, and what it took is free again.
        allowance.left = before
        raise RecordingError(f"{path}: {error}; unpack it first (mcap decompress), or read fewer at once") from None
    except UNREADABLE as error:
        raise RecordingError(f"{path}: damaged: {str(error) or type(error).__name__}") from None
    episodes = tuple(episode for episode in found.values() if episode.purpose is not None)
    if not episodes:
        raise RecordingError(f"{path}: holds no episode")
    if not any(episode.frames for episode in episodes):
        raise RecordingError(f"{path}: holds no camera frame")
    truncated = len(data) < 2 * len(MAGIC) or data[-len(MAGIC) :] != MAGIC
    return Recording(path, episodes, truncated, bad)


def _take(episode: RecordedEpisode, message: Message, fingerprint: str | None) -> None:
    """Take what a message tells; of several of a tick the first."""
    tick = message.tick
    match message:
        case Episode():
            _take_event(episode, message)
        case Observation():
            if message.fingerprint == fingerprint and tick not in episode.features:
                episode.features[tick] = message.features.to_numpy()
        case CommandApplied():
            # Several in one tick: the last is what moved the robot on to the next frame.
            last = episode.applied.setdefault(tick, message)
            if message.sequence > last.sequence:
                episode.applied[tick] = message
        case CameraInfo():
            episode.camera = message
        case Pose():
            episode.poses.setdefault(tick, message)
        case Odometry():
            episode.odometry.setdefault(tick, message)
        case Imu():
            episode.imu.setdefault(tick, message)
        case _:
            pass


def _take_event(episode: RecordedEpisode, event: Episode) -> None:
    episode.world, episode.seed, episode.goal = event.world, event.seed, event.goal
    episode.purpose, episode.driver = event.purpose, event.driver
    if event.event == "ended":
        episode.outcome, episode.end_tick = event.outcome, event.tick
