"""Reads recordings back: for each episode what the camera saw and what the actuator did, tick by tick.

Pure of Zenoh. Files may be truncated (their whole messages are read), may hold several episodes (each stays by
itself), and may lack ticks (an episode is given in pieces without gaps).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.base import ATOMS, Message, Source
from schemas.command import CommandApplied
from schemas.episode import Episode, Outcome, Purpose
from schemas.observation import Observation
from schemas.pose import Pose
from schemas.topics import APPLIED, CAMERA, EPISODE, OBSERVATION, POSE, Topic, topic_of
from services.recorder.records import MAGIC, fields, flat_records, message_header, message_payload, view_of
from services.recorder.sink import PARTIAL_SUFFIX, is_being_recorded

_STOP: Final = ATOMS.index("stop")


class RecordingError(Exception):
    """A file cannot be used as a recording; the text names it and says why in one line."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Successive frames of one episode without a gap.

    Attributes
    ----------
    ticks
        (f,) int64, each one more than the last.
    features
        (f, m) float32, raw feature vectors.
    atoms
        (f,) int8, index in ``schemas.base.ATOMS`` of the movement between frame k and frame k + 1.
    at_goal
        Whether the last frame is the one with which the episode ended, victim found.
    """

    ticks: NDArray[np.int64]
    features: NDArray[np.float32]
    atoms: NDArray[np.int8]
    at_goal: bool


@dataclass(eq=False)
class RecordedEpisode:
    """One episode, everything by tick.

    Attributes
    ----------
    robot, episode, world, seed, purpose, driver
        As in the episode's events.
    outcome, end_tick
        None if the end was not recorded.
    features
        Raw feature vectors that were recorded with the wanted fingerprint.
    images
        Recorded images (for ``encoding.decode_image``) of the ticks without such a vector.
    applied
        What the actuator did from this tick to the next.
    poses
        True poses, for plots; learning must not use them.
    """

    robot: str
    episode: str
    world: str = ""
    seed: int = 0
    purpose: Purpose | None = None
    driver: Source | None = None
    outcome: Outcome | None = None
    end_tick: int | None = None
    features: dict[int, NDArray[np.float32]] = field(default_factory=dict)
    images: dict[int, memoryview] = field(default_factory=dict)
    applied: dict[int, CommandApplied] = field(default_factory=dict)
    poses: dict[int, Pose] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """How many frames were recorded."""
        return len(self.features.keys() | self.images.keys())

    def pieces(self) -> list[Piece]:
        """Cut the episode wherever a frame's features, or what was done after it, are not known."""
        known = sorted(tick for tick in self.features if tick in self.applied or self._is_goal(tick))
        ticks = np.array(known, dtype=np.int64)
        breaks = np.flatnonzero(np.diff(ticks) > 1) + 1
        return [self._piece(run) for run in np.split(ticks, breaks) if run.size]

    def _piece(self, ticks: NDArray[np.int64]) -> Piece:
        features = np.stack([self.features[tick] for tick in ticks.tolist()])
        atoms = np.array([self._atom(tick) for tick in ticks.tolist()], dtype=np.int8)
        return Piece(ticks, features, atoms, at_goal=self._is_goal(int(ticks[-1])))

    def _is_goal(self, tick: int) -> bool:
        return self.outcome == "found" and tick == self.end_tick

    def _atom(self, tick: int) -> int:
        # With the victim found the robot stops. Any other end only says that nobody watched any more.
        return _STOP if self._is_goal(tick) else ATOMS.index(self.applied[tick].atom)


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


def read_recording(path: Path, fingerprint: str | None = None) -> Recording:
    """Read a recording.

    Parameters
    ----------
    path
        An MCAP file, finished or left behind.
    fingerprint
        Which feature vectors to take from the observations; none of them if not given.

    Raises
    ------
    RecordingError
        When the file cannot be read, is no MCAP file, holds no episode or no frame, or is still being recorded.
    """
    data = _open(path)
    reader = _Reader(fingerprint)
    try:
        for record in flat_records(data):
            reader.take(record.opcode, record.body)
    except (McapError, ValueError, struct.error) as error:
        raise RecordingError(f"{path}: damaged: {str(error) or type(error).__name__}") from None
    episodes = tuple(episode for episode in reader.episodes.values() if episode.purpose is not None)
    if not episodes:
        raise RecordingError(f"{path}: holds no episode")
    if not any(episode.frames for episode in episodes):
        raise RecordingError(f"{path}: holds no camera frame")
    truncated = len(data) < 2 * len(MAGIC) or data[-len(MAGIC) :] != MAGIC
    return Recording(path, episodes, truncated, reader.bad)


def _open(path: Path) -> memoryview:
    try:
        if path.suffix == PARTIAL_SUFFIX and is_being_recorded(path):
            raise RecordingError(f"{path}: still being recorded; end the episode or stop the recorder first")
        with path.open("rb") as file:
            data = view_of(file.fileno())
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
    except ValueError:
        raise RecordingError(f"{path}: empty") from None
    if data[: len(MAGIC)] != MAGIC:
        raise RecordingError(f"{path}: not an MCAP file")
    return data


class _Reader:
    """Sorts the records of a file into episodes."""

    def __init__(self, fingerprint: str | None) -> None:
        self.episodes: dict[tuple[str, str], RecordedEpisode] = {}
        self.bad = 0
        self._fingerprint = fingerprint
        self._channels: dict[int, tuple[Topic, str, str]] = {}
        self._take: dict[str, Callable[[RecordedEpisode, Message], None]] = {
            EPISODE.name: self._take_event,
            OBSERVATION.name: self._take_observation,
            APPLIED.name: self._take_applied,
            POSE.name: self._take_pose,
        }

    def take(self, opcode: int, body: memoryview) -> None:
        """Take one record."""
        if opcode == Opcode.CHANNEL:
            self._take_channel(Channel.read(fields(body)))
        elif opcode == Opcode.MESSAGE:
            header = message_header(body)
            if header.channel_id in self._channels:
                topic, robot, episode = self._channels[header.channel_id]
                self._take_message(topic, robot, episode, header.sequence, message_payload(body))

    def _take_channel(self, channel: Channel) -> None:
        topic = topic_of(channel.topic)
        robot, episode = channel.metadata.get("robot"), channel.metadata.get("episode")
        # Anything else in the file is other people's.
        if topic is not None and robot is not None and episode is not None:
            self._channels[channel.id] = (topic, robot, episode)

    def _take_message(self, topic: Topic, robot: str, episode: str, tick: int, payload: memoryview) -> None:
        record = self.episodes.setdefault((robot, episode), RecordedEpisode(robot, episode))
        if topic is CAMERA:
            if tick not in record.features:
                record.images.setdefault(tick, payload)
            return
        take = self._take.get(topic.name)
        if take is None:
            return
        try:
            message = topic.message.model_validate_json(bytes(payload))
        except ValidationError:
            self.bad += 1
            return
        if (message.robot, message.episode) != (robot, episode):
            self.bad += 1
            return
        take(record, message)

    def _take_event(self, record: RecordedEpisode, event: Message) -> None:
        assert isinstance(event, Episode)  # noqa: S101 - by the table of topics
        record.world, record.seed, record.purpose, record.driver = event.world, event.seed, event.purpose, event.driver
        if event.event == "ended":
            record.outcome, record.end_tick = event.outcome, event.tick

    def _take_observation(self, record: RecordedEpisode, observation: Message) -> None:
        assert isinstance(observation, Observation)  # noqa: S101 - by the table of topics
        if observation.fingerprint == self._fingerprint and observation.tick not in record.features:
            record.features[observation.tick] = observation.features.to_numpy()
            record.images.pop(observation.tick, None)

    def _take_applied(self, record: RecordedEpisode, applied: Message) -> None:
        assert isinstance(applied, CommandApplied)  # noqa: S101 - by the table of topics
        # Several in one tick: the last is what moved the robot on to the next frame.
        last = record.applied.get(applied.tick)
        if last is None or applied.sequence > last.sequence:
            record.applied[applied.tick] = applied

    def _take_pose(self, record: RecordedEpisode, pose: Message) -> None:
        assert isinstance(pose, Pose)  # noqa: S101 - by the table of topics
        record.poses.setdefault(pose.tick, pose)


def recordings_in(paths: list[Path]) -> Iterator[Path]:
    """Yield the recordings among files and folders (of a folder: its ``*.mcap``, and those left unfinished)."""
    for path in paths:
        if path.is_dir():
            yield from sorted(p for p in path.iterdir() if p.name.endswith((".mcap", f".mcap{PARTIAL_SUFFIX}")))
        else:
            yield path
