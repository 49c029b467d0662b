"""A recorded episode as its robot told it: what to publish at each tick, and when."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from mcap.exceptions import McapError
from mcap.records import Channel
from mcap.records import Message as StoredMessage

from schemas import topics
from schemas.base import Message
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode
from schemas.image import Image
from schemas.topics import Topic, topic_of
from services.kit.jpeg import decode_jpeg
from services.recordings.encoding import stamped_jpeg
from services.recordings.ledger import order_of
from services.recordings.reader import IMAGES, RecordingError, being_recorded, open_recording
from services.recordings.records import Allowance, records
from services.table import SERVICES

#: What can be replayed, in the order in which a robot publishes it within a tick: of what it gives, whatever is
#: recorded, or can be made of it. What commands a robot is never among it.
REPLAYABLE: Final = {
    topic.name: topic
    for topic in (
        *(topics.CAMERA_INFO, topics.ODOMETRY, topics.IMU, topics.POSE, topics.CAMERA, topics.JPEG),
        *(topics.EPISODE, topics.APPLIED),
    )
    if topic in SERVICES["robot"].gives
}


class Tick(NamedTuple):
    """What is told at once."""

    number: int
    """As in the recording."""
    since_s: float
    """Time since the first tick."""
    messages: tuple[Message, ...]
    """In the order in which the robot told them."""


@dataclass(eq=False)
class Track:
    """What a robot told in one episode.

    Attributes
    ----------
    robot, episode
        Its ids in the recording.
    bad
        Messages so far that did not decode; they are left out.
    """

    robot: str
    episode: str
    bad: int = 0
    _told: dict[int, dict[str, list[memoryview]]] = field(default_factory=dict)
    _stamps_ns: dict[int, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._told)

    def add(self, topic: Topic, stored: StoredMessage) -> None:
        """Take a message."""
        # Images of old recordings have the key of raw ones.
        name = topics.JPEG.name if topic in IMAGES else topic.name
        self._told.setdefault(stored.sequence, {}).setdefault(name, []).append(memoryview(stored.data))
        self._stamps_ns.setdefault(stored.sequence, stored.log_time)

    def play(self, robot: str, episode: str, began_ns: int, wanted: Mapping[str, Topic]) -> Iterator[Tick]:
        """Yield tick after tick, under other ids.

        It is told as a run, so that who records it has no second demonstration.

        Parameters
        ----------
        robot, episode
            Ids to tell it by.
        began_ns
            Stamp of the first tick. The others are as far from it as they were, so that what goes by the time between
            frames does as it did.
        wanted
            Topics to tell, out of `REPLAYABLE`.
        """
        first_ns = min(self._stamps_ns.values())
        for tick in sorted(self._told):
            since_ns = self._stamps_ns[tick] - first_ns
            header = {"robot": robot, "episode": episode, "stamp_ns": began_ns + since_ns}
            messages = sorted(self._messages(tick, wanted), key=_place)
            yield Tick(tick, since_ns / 1e9, tuple(_told_anew(message, header) for message in messages))

    def _messages(self, tick: int, wanted: Mapping[str, Topic]) -> Iterator[Message]:
        for name, payloads in self._told[tick].items():
            for payload in payloads:
                try:
                    if name == topics.JPEG.name:
                        yield from self._images(tick, bytes(payload), wanted)
                    elif name in wanted:
                        yield wanted[name].message.model_validate_json(bytes(payload))
                except ValueError:
                    self.bad += 1

    def _images(self, tick: int, payload: bytes, wanted: Mapping[str, Topic]) -> Iterator[Message]:
        if not wanted.keys() & {topic.name for topic in IMAGES}:
            return
        data = stamped_jpeg(payload)[1]
        pixels = decode_jpeg(data)
        height, width, _ = pixels.shape
        header = Message(robot=self.robot, episode=self.episode, tick=tick, stamp_ns=self._stamps_ns[tick])
        if topics.CAMERA.name in wanted:
            yield Image.after(header, width=width, height=height, data=pixels.tobytes())
        if topics.JPEG.name in wanted:
            yield CompressedImage.after(header, width=width, height=height, data=data)


def _place(message: Message) -> tuple[int, ...]:
    """Return where in a tick a message stands: `started` first, `ended` last."""
    order = [*REPLAYABLE].index(message.topic_name)
    if isinstance(message, Episode):
        return {"started": -1, "ended": len(REPLAYABLE)}.get(message.event, order), *order_of(message)
    return order, *order_of(message)


def _told_anew(message: Message, header: dict[str, object]) -> Message:
    more = {"purpose": "run"} if isinstance(message, Episode) else {}
    return message.model_copy(update=header | more)


def end_of(last: Message, started: Episode) -> Episode:
    """Make what tells that an episode is over of which no end was recorded, or that is not told to its end."""
    told = started.model_dump(include={"purpose", "driver", "world", "seed", "goal"})
    return Episode.after(last, event="ended", outcome="aborted", **told)


def tracks_of(path: Path) -> tuple[Track, ...]:
    """Read what robots told, in the order of their episodes in the file.

    Raises
    ------
    RecordingError
        When it cannot be read, is still being recorded, holds no episode, or takes too much memory.
    """
    if being_recorded(path):
        raise RecordingError(f"{path}: still being recorded; end the episode or stop the recorder first")
    tracks: dict[tuple[str, str], Track] = {}
    allowance = Allowance()
    try:
        _read(open_recording(path), tracks, allowance)
    except (McapError, ValueError, struct.error) as error:
        raise RecordingError(
            f"{path}: damaged: {str(error) or type(error).__name__}; see smal recording repair"
        ) from None
    if not tracks:
        raise RecordingError(f"{path}: holds nothing that a robot told")
    return tuple(tracks.values())


def _read(data: memoryview, tracks: dict[tuple[str, str], Track], allowance: Allowance) -> None:
    channels: dict[int, tuple[Topic, tuple[str, str]]] = {}
    for record in records(data, allowance):
        match record:
            case Channel(metadata={"robot": robot, "episode": episode}):
                topic = topic_of(record.topic)
                channels.pop(record.id, None)
                if topic is not None and (topic.name in REPLAYABLE):
                    channels[record.id] = topic, (robot, episode)
            case StoredMessage(channel_id=number) if number in channels:
                topic, ids = channels[number]
                tracks.setdefault(ids, Track(*ids)).add(topic, record)
            case _:
                pass
