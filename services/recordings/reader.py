"""Reader of recordings, also truncated files, as episodes."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from schemas.camera import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Imu, Odometry, TruePose
from schemas.topics import APPLIED, CAMERA_INFO, EPISODE, JPEG, ODOMETRY, POSE, Topic
from services.recordings.recorded import RecordedEpisode
from services.recordings.records import MAGIC, Allowance, mapped
from services.recordings.stream import RecordingError, StoredMessage, messages_of

USUAL: Final = (JPEG, CAMERA_INFO, ODOMETRY, POSE, APPLIED)  # For teaching and plots.


@dataclass(frozen=True, eq=False)
class Recording:
    """The episodes of a file."""

    path: Path
    episodes: tuple[RecordedEpisode, ...]  # In the order of appearance.
    truncated: bool  # Whether the end of the file is missing.
    bad: int  # Number of messages that do not match their topic; they are left out.

    def remarks(self) -> Iterator[str]:
        """Yield a line for each defect."""
        if self.truncated:
            yield (
                f"{self.path}: truncated; {sum(one.frames for one in self.episodes)} "
                "complete frames are read"
            )
        if self.bad:
            yield f"{self.path}: {self.bad} malformed messages left out"


def read_recording(
    path: Path, allowance: Allowance | None = None, topics: Collection[Topic] = USUAL
) -> Recording:
    """Read the episodes and some topics of a recording, sealed or unfinished.

    Raises
    ------
    RecordingError
        If the file cannot be read, is not an MCAP file, contains no episode or no frame, is being
        recorded, or takes more memory than the ``allowance``.
    """
    found: dict[tuple[str, str], RecordedEpisode] = {}
    bad = 0
    for stored in messages_of(path, (EPISODE, *topics), allowance):
        ids = stored.robot, stored.episode
        episode = found.setdefault(ids, RecordedEpisode(*ids))
        if stored.topic is JPEG:
            episode.images.setdefault(stored.tick, stored.payload)
            episode.stamps_ns.setdefault(stored.tick, stored.stamp_ns)
            continue
        try:
            _take(episode, stored)
        except ValueError:
            bad += 1
    episodes = tuple(episode for episode in found.values() if episode.purpose is not None)
    if not episodes:
        raise RecordingError(f"{path}: no episode in this recording")
    if not any(episode.frames for episode in episodes):
        raise RecordingError(f"{path}: no camera frame in this recording")
    return Recording(path, episodes, mapped(path)[-len(MAGIC) :] != MAGIC, bad)


def _take(episode: RecordedEpisode, stored: StoredMessage) -> None:
    """Add a message to its episode; the first of a tick counts, but the last applied command."""
    message = stored.message()
    tick = message.tick
    match message:
        case Episode():
            episode.world = message.world
            episode.seed = message.seed
            episode.goal = message.goal
            episode.purpose = message.purpose
            episode.driver = message.driver
            if message.event == "kidnapped":
                episode.kidnapped.append(tick)
            if message.event == "ended":
                episode.outcome = message.outcome
                episode.end_tick = tick
                episode.box = message.box
        case CommandApplied():
            # The last command of a tick moved the robot to the next frame.
            last = episode.applied.setdefault(tick, message)
            if message.sequence > last.sequence:
                episode.applied[tick] = message
        case CameraInfo():
            episode.camera = message
        case TruePose():
            episode.poses.setdefault(tick, message)
        case Odometry():
            episode.odometry.setdefault(tick, message)
        case Imu():
            episode.imu.setdefault(tick, message)
