"""Reads recordings back, also truncated ones: for each episode what camera and actuator did, tick by tick."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.camera import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Imu, Odometry, Pose
from schemas.observation import Observation
from schemas.topics import APPLIED, CAMERA_INFO, EPISODE, JPEG, OBSERVATION, ODOMETRY, POSE, Topic
from services.recordings.recorded import RecordedEpisode
from services.recordings.records import MAGIC, Allowance, copied, mapped
from services.recordings.stream import RecordingError, Stored, messages_of

USUAL: Final = (
    JPEG,
    CAMERA_INFO,
    ODOMETRY,
    POSE,
    OBSERVATION,
    APPLIED,
)  # For teaching, and to be drawn.


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
    found: dict[tuple[str, str], RecordedEpisode] = {}
    bad = 0
    for stored in messages_of(path, (EPISODE, *topics), allowance):
        ids = stored.robot, stored.episode
        episode = found.setdefault(ids, RecordedEpisode(*ids))
        if stored.topic is JPEG:
            episode.images.setdefault(stored.tick, stored.payload)
            continue
        try:
            _take(episode, stored, fingerprint)
        except ValueError:
            bad += 1
    episodes = tuple(episode for episode in found.values() if episode.purpose is not None)
    if not episodes:
        raise RecordingError(f"{path}: holds no episode")
    if not any(episode.frames for episode in episodes):
        raise RecordingError(f"{path}: holds no camera frame")
    return Recording(path, episodes, mapped(path)[-len(MAGIC) :] != MAGIC, bad)


def _features(payload: memoryview) -> NDArray[np.float32]:
    """Return the features of a recorded observation."""
    return Observation.model_validate_json(copied(payload)).features.to_numpy()


def _take(episode: RecordedEpisode, stored: Stored, fingerprint: str | None) -> None:
    """Take what a message tells; of several of a tick the first."""
    message = stored.message()
    tick = message.tick
    match message:
        case Episode():
            episode.world = message.world
            episode.seed = message.seed
            episode.goal = message.goal
            episode.purpose = message.purpose
            episode.driver = message.driver
            if message.event == "ended":
                episode.outcome = message.outcome
                episode.end_tick = tick
                episode.box = message.box
        case Observation() if message.fingerprint == fingerprint:
            episode.features.setdefault(tick, partial(_features, stored.payload))
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
