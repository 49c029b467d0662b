"""Summary of the contents and defects of a recording."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise, starmap
from pathlib import Path
from typing import Final

from mcap.records import McapRecord, Metadata

from schemas.base import Message
from schemas.camera import CameraInfo, CompressedImage
from schemas.codec import printable
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Odometry
from schemas.topics import JPEG, TOPICS, Topic
from services.kit.cameras import camera_of
from services.recordings.ledger import Ledger
from services.recordings.records import MemoryLimitError
from services.recordings.sink import PARTIAL_SUFFIX
from services.recordings.stream import (
    RecordingError,
    StoredMessage,
    being_recorded,
    messages,
    open_recording,
)
from services.recordings.survey import summary_of, surveyed
from services.recordings.views import is_view
from services.recordings.writer import EPISODE_METADATA

_SAID: Final = ("world", "seed", "purpose", "goal", "driver")  # See `schemas.episode`.


@dataclass
class Counted:
    """The messages of one topic."""

    messages: int = 0
    size: int = 0
    first_ns: int = 2**64
    last_ns: int = 0

    def add(self, stored: StoredMessage) -> None:
        """Count a message."""
        self.first_ns = min(self.first_ns, stored.stamp_ns)
        self.last_ns = max(self.last_ns, stored.stamp_ns)
        self.messages += 1
        self.size += len(stored.payload)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate; None if all messages have the same stamp."""
        elapsed_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * 1e9 / elapsed_ns if elapsed_ns > 0 else None


@dataclass
class EpisodeContents:
    """One episode; None stands for unrecorded values."""

    robot: str
    episode: str
    #: World, seed, purpose, goal and driver.
    said: dict[str, str | int] = field(default_factory=dict)
    outcome: str | None = None
    judge: str | None = None  # Source of the outcome.
    kidnapped: list[int] = field(default_factory=list)  # Ticks before which the robot was moved.
    #: Ticks by the source of the last command applied in them.
    drove: dict[str, int] = field(default_factory=dict)
    topics: defaultdict[str, Counted] = field(default_factory=lambda: defaultdict(Counted))
    width: int | None = None
    height: int | None = None
    field_of_view_deg: float | None = None
    odometry_m: float | None = None  # Length of the route by odometry.

    @property
    def frames(self) -> int:
        """Number of images."""
        return self.topics[JPEG.name].messages if JPEG.name in self.topics else 0

    @property
    def seconds(self) -> float:
        """Time from the first message to the last."""
        counted = self.topics.values()
        if not counted:
            return 0.0
        return (max(one.last_ns for one in counted) - min(one.first_ns for one in counted)) / 1e9


@dataclass
class Contents:
    """One recording; sizes are in bytes."""

    path: Path
    state: str  # ``sealed``, ``not sealed``, or ``being recorded``.
    size: int
    about: dict[str, str] = field(default_factory=dict)  # Metadata: software, time of recording.
    episodes: list[EpisodeContents] = field(default_factory=list)
    views: int = 0  # Messages for viewers, derived from the others.
    views_size: int = 0
    others: int = 0  # Messages of foreign topics.
    damage: list[str] = field(default_factory=list)  # Defects of the file, a line each.
    lacks: list[str] = field(default_factory=list)  # Missing messages, a line each.

    @property
    def findings(self) -> list[str]:
        """All defects, one per line."""
        return [*self.damage, *self.lacks]


def verify(path: Path) -> Contents:
    """Check every checksum, message and tick of a recording; raise errors as `contents_of` does."""
    return contents_of(path, thorough=True)


def contents_of(path: Path, *, thorough: bool = False) -> Contents:
    """Return the contents of a recording.

    Raises
    ------
    RecordingError
        If the file is not a recording, or unpacks to too much memory.
    """
    data = open_recording(path, living=True)
    contents = Contents(path, _state_of(path, data), len(data))
    if contents.state != "sealed":
        left = path.suffix == PARTIAL_SUFFIX
        why = "left behind" if left else "end with the index is missing or damaged"
        contents.damage.append(f"{contents.state}: {why}")
    episodes: dict[tuple[str, str], _Reading] = {}
    for topic, stored in _episode_messages(contents, data):
        ids = stored.robot, stored.episode
        if ids not in episodes:
            episodes[ids] = _Reading(EpisodeContents(*ids), thorough)
        episodes[ids].take(topic, stored)
    contents.episodes = [reading.summed_up() for reading in episodes.values()]
    if thorough:
        for reading in episodes.values():
            reading.conclude(contents)
        if not episodes:
            contents.lacks.append("no episode")
    return contents


def _state_of(path: Path, data: memoryview) -> str:
    if being_recorded(path):
        return "being recorded"
    left = path.suffix == PARTIAL_SUFFIX
    return "not sealed" if left or summary_of(data) is None else "sealed"


def _episode_messages(
    contents: Contents, data: memoryview
) -> Iterator[tuple[Topic, StoredMessage]]:
    """Yield the messages of our topics, and count the others."""
    try:
        for stored in messages(_noting(contents, surveyed(data, contents.damage.append))):
            if is_view(stored.key):
                contents.views += 1
                contents.views_size += len(stored.payload)
            elif stored.topic is None:
                contents.others += 1
            else:
                yield stored.topic, stored
    except MemoryLimitError as error:
        raise RecordingError(
            f"{contents.path}: {error}; unpack it first (mcap decompress)"
        ) from None


def _noting(contents: Contents, records: Iterable[McapRecord]) -> Iterator[McapRecord]:
    for record in records:
        if isinstance(record, Metadata) and record.name == EPISODE_METADATA:
            contents.about |= record.metadata
        yield record


class _Reading:
    def __init__(self, episode: EpisodeContents, thorough: bool) -> None:
        self.episode = episode
        self._thorough = thorough
        self._ledger = Ledger()
        self._bad: dict[str, list[str]] = defaultdict(list)
        self._twice: dict[str, list[int]] = defaultdict(list)
        self._drivers: dict[int, tuple[int, str]] = {}
        self._places: dict[int, tuple[float, float]] = {}
        self._began = False
        self._end: int | None = None

    def take(self, topic: Topic, stored: StoredMessage) -> None:
        self.episode.topics[topic.name].add(stored)
        if not self._thorough and not self._is_needed(topic):
            return
        try:
            message = stored.message(pixels=self._thorough)
            if (message.tick, message.stamp_ns) != (stored.tick, stored.stamp_ns):
                raise ValueError("tick or time differs from its record")
        except ValueError as error:
            self._bad[topic.name].append(f"tick {stored.tick}: {printable(str(error))}")
        else:
            self._note(message)
            if not self._ledger.admit(message):
                self._twice[topic.name].append(stored.tick)

    def _is_needed(self, topic: Topic) -> bool:
        """Return whether a message describes the episode as a whole; the first image is enough."""
        if topic is JPEG:
            return self.episode.width is None
        return issubclass(topic.message, Episode | CommandApplied | CameraInfo | Odometry)

    def _note(self, message: Message) -> None:
        episode = self.episode
        match message:
            case Episode():
                episode.said = {name: getattr(message, name) for name in _SAID}
                self._began |= message.event == "started"
                if message.event == "kidnapped":
                    episode.kidnapped.append(message.tick)
                if message.event == "ended":
                    episode.outcome = message.outcome
                    episode.judge = message.judge
                    self._end = message.tick
            case CommandApplied():
                last = self._drivers.get(message.tick)
                if last is None or message.sequence > last[0]:
                    self._drivers[message.tick] = message.sequence, message.source or "nobody"
            case CompressedImage() if episode.width is None:
                episode.width = message.width
                episode.height = message.height
            case CameraInfo():
                episode.field_of_view_deg = camera_of(message).field_deg
            case Odometry():
                self._places[message.tick] = message.x_m, message.y_m
            case _:
                pass

    def summed_up(self) -> EpisodeContents:
        self.episode.drove = dict(Counter(driver for _, driver in self._drivers.values()))
        if self._places:
            # After an outage a pose can be late.
            way = [self._places[tick] for tick in sorted(self._places)]
            self.episode.odometry_m = sum(starmap(math.dist, pairwise(way)), 0.0)
        return self.episode

    def conclude(self, contents: Contents) -> None:
        name = f"episode {self.episode.episode}"
        for topic, bad in self._bad.items():
            count = self.episode.topics[topic].messages
            contents.damage.append(
                f"{name}: {topic}: {len(bad)} of {count} cannot be decoded: {bad[0]}"
            )
        for topic, twice in self._twice.items():
            contents.damage.append(
                f"{name}: {topic}: {len(twice)} duplicates, the first at tick {twice[0]}"
            )
        if not self._began:
            contents.lacks.append(f"{name}: start not recorded")
        if self._end is None:
            contents.lacks.append(f"{name}: end not recorded")
        else:
            self._ledger.close(self._end)
        contents.lacks += [
            f"{name}: {topic} lacks {ticks}" for topic, ticks in self._ledger.gaps().items()
        ]


def named_topics(episode: EpisodeContents) -> Iterator[tuple[str, Counted]]:
    """Yield the recorded topics in the order of the table."""
    for name in TOPICS:
        if name in episode.topics:
            yield name, episode.topics[name]
