"""What is in a recording, and what is wrong with it: for people, who have many of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from google.protobuf.message import DecodeError as ProtobufDecodeError
from mcap.records import Channel, Metadata
from mcap.records import Message as StoredMessage
from pydantic import ValidationError

from schemas.base import Message
from schemas.camera_info import CameraInfo
from schemas.codec import describe, printable
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.observation import Observation
from schemas.odometry import Odometry
from schemas.topics import TOPICS, Topic, topic_of
from services.recordings.encoding import decode_image, size_of_image
from services.recordings.ledger import Ledger, Order, order_of
from services.recordings.reader import IMAGES, RecordingError, being_recorded, open_recording
from services.recordings.records import MemoryLimitError
from services.recordings.sink import PARTIAL_SUFFIX
from services.recordings.survey import Summary, summary_of, surveyed
from services.recordings.views import is_view
from services.recordings.writer import EPISODE_METADATA

#: Of an episode's events, what says who drove where; see `schemas.episode`.
_SAID: Final = ("world", "seed", "purpose", "goal", "driver")


@dataclass
class Counted:
    """The messages of one topic."""

    messages: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def add(self, stamp_ns: int, size: int) -> None:
        """Count one."""
        self.first_ns = min(self.first_ns, stamp_ns) if self.messages else stamp_ns
        self.last_ns = max(self.last_ns, stamp_ns)
        self.messages += 1
        self.size += size

    @property
    def rate_hz(self) -> float | None:
        """From the first to the last; None where that is one moment."""
        elapsed_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * 1e9 / elapsed_ns if elapsed_ns > 0 else None


@dataclass
class EpisodeContents:
    """One episode.

    Attributes
    ----------
    robot, episode
        Their ids.
    said
        World, seed, purpose, goal and driver, as its events or the file's metadata tell.
    outcome, judge
        How it ended, and who says so; None where its end was not recorded.
    drove
        Ticks by whose command moved the robot last in them.
    topics
        What was recorded, by topic.
    width, height, focal_px
        Of the camera; None where that was not recorded.
    modalities
        Of the features.
    odometry_m
        Way by the wheels; None without odometry.
    """

    robot: str
    episode: str
    said: dict[str, str | int] = field(default_factory=dict)
    outcome: str | None = None
    judge: str | None = None
    drove: dict[str, int] = field(default_factory=dict)
    topics: defaultdict[str, Counted] = field(default_factory=lambda: defaultdict(Counted))
    width: int | None = None
    height: int | None = None
    focal_px: float | None = None
    modalities: tuple[str, ...] = ()
    odometry_m: float | None = None

    @property
    def frames(self) -> int:
        """How many images there are."""
        return max((self.topics[topic.name].messages for topic in IMAGES if topic.name in self.topics), default=0)

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        if not self.topics:
            return 0.0
        first_ns = min(one.first_ns for one in self.topics.values())
        return (max(one.last_ns for one in self.topics.values()) - first_ns) / 1e9


@dataclass
class Contents:
    """One recording.

    Attributes
    ----------
    path
        The file.
    state
        ``sealed``, ``not sealed``, or ``being recorded``.
    size
        Bytes.
    about
        What the recorder wrote of itself: software, when.
    episodes
        In the order in which they begin in the file.
    views, views_size
        What is there for viewers, derived from the rest: messages, and their bytes.
    others
        Messages of topics that are not ours.
    damage, lacks
        What is wrong in the file, and what never came into it; a line each.
    """

    path: Path
    state: str
    size: int
    about: dict[str, str] = field(default_factory=dict)
    episodes: list[EpisodeContents] = field(default_factory=list)
    views: int = 0
    views_size: int = 0
    others: int = 0
    damage: list[str] = field(default_factory=list)
    lacks: list[str] = field(default_factory=list)

    @property
    def findings(self) -> list[str]:
        """All that is wrong with it."""
        return [*self.damage, *self.lacks]


def contents_of(path: Path) -> Contents:
    """Tell what is in a recording; what of it does not decode is counted only.

    Raises
    ------
    RecordingError
        When it is no recording at all, or unpacks to too much.
    """
    return _Survey(path, thorough=False).contents


def verify(path: Path) -> Contents:
    """Read all of a recording: every checksum, every message, every tick.

    Raises
    ------
    RecordingError
        As of `contents_of`.
    """
    return _Survey(path, thorough=True).contents


def decoded(topic: Topic, robot: str, episode: str, payload: bytes) -> Message:
    """Return the message of a topic, which has no images, in an episode.

    Raises
    ------
    ValueError
        When it is none.
    """
    message = topic.message.model_validate_json(payload)
    if (message.robot, message.episode, message.topic_name) != (robot, episode, topic.name):
        raise ValueError("of another robot, episode or topic than its channel")
    return message


class _Survey:
    """Reads one recording."""

    def __init__(self, path: Path, *, thorough: bool) -> None:
        recorded = being_recorded(path)
        data = open_recording(path)
        summary = summary_of(data)
        sealed = path.suffix != PARTIAL_SUFFIX and summary is not None
        state = "being recorded" if recorded else "sealed" if sealed else "not sealed"
        self.contents = Contents(path, state, len(data))
        self._thorough = thorough
        self._found: dict[tuple[str, str], _EpisodeSurvey] = {}
        if not sealed:
            left = path.suffix == PARTIAL_SUFFIX
            self._tell(f"{state}: {'left behind' if left else 'its end, with the index, is missing or damaged'}")
        try:
            self._read(data, summary)
        except MemoryLimitError as error:
            raise RecordingError(f"{path}: {error}; unpack it first (mcap decompress)") from None
        for survey in self._found.values():
            if survey.episode.topics:
                self.contents.episodes.append(survey.episode)
        if thorough:
            for survey in self._found.values():
                self.contents.damage += survey.damage()
                self.contents.lacks += survey.lacks()
            if not self.contents.episodes:
                self.contents.lacks.append("holds no episode")

    def _tell(self, line: str) -> None:
        self.contents.damage.append(line)

    def _read(self, data: memoryview, summary: Summary | None) -> None:
        known = () if summary is None else summary.records
        channels = {one.id: one for one in known if isinstance(one, Channel)}
        count = unknown = 0
        for record in surveyed(data, self._tell):
            match record:
                case Channel():
                    channels[record.id] = record
                case Metadata(name=name) if name == EPISODE_METADATA:
                    self.contents.about |= record.metadata
                case StoredMessage():
                    count += 1
                    channel = channels.get(record.channel_id)
                    unknown += channel is None
                    if channel is not None:
                        self._take(channel, record)
        if unknown:
            self._tell(f"{unknown} messages are of a channel that is lost")
        if summary is not None and summary.messages not in (None, count):
            self._tell(f"its index tells of {summary.messages} messages, and there are {count}")

    def _take(self, channel: Channel, stored: StoredMessage) -> None:
        topic = topic_of(channel.topic)
        robot, episode = channel.metadata.get("robot"), channel.metadata.get("episode")
        if is_view(channel.topic):
            self.contents.views += 1
            self.contents.views_size += len(stored.data)
            return
        if topic is None or robot is None or episode is None:
            self.contents.others += 1
            return
        key = printable(robot), printable(episode)
        if key not in self._found:
            self._found[key] = _EpisodeSurvey(EpisodeContents(*key), self._thorough)
        self._found[key].take(topic, stored)


class _EpisodeSurvey:
    """Reads one episode."""

    def __init__(self, episode: EpisodeContents, thorough: bool) -> None:
        self.episode = episode
        self._thorough = thorough
        self._ledger = Ledger()
        self._bad: dict[str, list[str]] = defaultdict(list)
        self._twice: dict[str, list[int]] = defaultdict(list)
        self._last_applied: dict[int, CommandApplied] = {}
        self._pose: tuple[float, float] | None = None
        self._began = False
        self._end: int | None = None

    def take(self, topic: Topic, stored: StoredMessage) -> None:
        """Take one message."""
        self.episode.topics[topic.name].add(stored.log_time, len(stored.data))
        payload = bytes(stored.data)
        try:
            order = self._take_image(payload, stored) if topic in IMAGES else self._take_message(topic, payload, stored)
        except ValidationError as error:
            self._bad[topic.name].append(f"tick {stored.sequence}: {describe(error)}")
        except (ValueError, ProtobufDecodeError) as error:
            self._bad[topic.name].append(f"tick {stored.sequence}: {printable(str(error))}")
        else:
            if order is not None and not self._ledger.admit(topic.name, order):
                self._twice[topic.name].append(stored.sequence)

    def _take_image(self, payload: bytes, stored: StoredMessage) -> Order:
        if self._thorough:
            decode_image(payload)
        if self.episode.width is None:
            self.episode.width, self.episode.height = size_of_image(payload)
        return stored.sequence, 0

    def _take_message(self, topic: Topic, payload: bytes, stored: StoredMessage) -> Order | None:
        if not self._thorough and not self._tells(topic):
            return None
        message = decoded(topic, self.episode.robot, self.episode.episode, payload)
        if (message.tick, message.stamp_ns) != (stored.sequence, stored.log_time):
            raise ValueError("its tick or time is another than its record's")
        self._note(message)
        return order_of(message)

    def _tells(self, topic: Topic) -> bool:
        """Whether a message says something about the episode as a whole; of large ones the first is enough."""
        if topic.message is Observation:
            return not self.episode.modalities
        return issubclass(topic.message, Episode | CommandApplied | CameraInfo | Odometry)

    def _note(self, message: Message) -> None:
        episode = self.episode
        match message:
            case Episode():
                episode.said = {name: getattr(message, name) for name in _SAID}
                self._began |= message.event == "started"
                if message.event == "ended":
                    episode.outcome, episode.judge, self._end = message.outcome, message.judge, message.tick
            case CommandApplied():
                last = self._last_applied.get(message.tick)
                if last is None or message.sequence > last.sequence:
                    self._count_driver(last, -1)
                    self._count_driver(message, 1)
                    self._last_applied[message.tick] = message
            case CameraInfo():
                episode.width, episode.height, episode.focal_px = message.width, message.height, message.focal_px
            case Observation():
                episode.modalities = message.modalities
            case Odometry():
                here = message.x_m, message.y_m
                x_m, y_m = self._pose or here
                step_m = ((here[0] - x_m) ** 2 + (here[1] - y_m) ** 2) ** 0.5
                episode.odometry_m, self._pose = (episode.odometry_m or 0.0) + step_m, here
            case _:
                pass

    def _count_driver(self, applied: CommandApplied | None, by: int) -> None:
        if applied is not None:
            name = applied.source or "nobody"
            self.episode.drove[name] = self.episode.drove.get(name, 0) + by

    @property
    def _name(self) -> str:
        return f"episode {self.episode.episode}"

    def damage(self) -> Iterator[str]:
        """Yield what is wrong with what is there, a line each."""
        for name, bad in self._bad.items():
            yield f"{self._name}: {name}: {len(bad)} of {self.episode.topics[name].messages} do not decode: {bad[0]}"
        for name, twice in self._twice.items():
            yield f"{self._name}: {name}: {len(twice)} are there twice, the first of tick {twice[0]}"

    def lacks(self) -> Iterator[str]:
        """Yield what is not there, a line each."""
        if not self._began:
            yield f"{self._name}: its beginning was not recorded"
        if self._end is None:
            yield f"{self._name}: its end was not recorded"
        else:
            self._ledger.close(self._end)
        for topic, ticks in self._ledger.gaps().items():
            yield f"{self._name}: {topic} lacks {ticks}"


def named_topics(episode: EpisodeContents) -> Iterator[tuple[str, Counted]]:
    """Yield what was recorded, in the order of the table of topics."""
    for name in TOPICS:
        if name in episode.topics:
            yield name, episode.topics[name]
