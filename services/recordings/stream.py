"""Messages of a recording one after the other, each with its robot and episode."""

import os
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from mcap.records import Channel, McapRecord
from mcap.records import Message as MessageRecord
from pydantic import ValidationError

from schemas.base import EPISODE_ID_PATTERN, ROBOT_ID_PATTERN, Message
from schemas.camera import CompressedImage
from schemas.codec import describe
from schemas.topics import JPEG, Topic, topic_of
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg, jpeg_size
from services.recordings.encoding import stamped_jpeg
from services.recordings.records import (
    MAGIC,
    UNREADABLE,
    Allowance,
    MemoryLimitError,
    copied,
    mapped,
    records,
)
from services.recordings.sink import PARTIAL_SUFFIX, claim

#: Memory of a kept message beside its bytes: its object and its numbers.
OBJECTS: Final = 2048


class RecordingError(JobError):
    """Raised when a file cannot be used as a recording; the text has its name."""


def being_recorded(path: Path) -> bool:
    """Return whether a running recorder writes this file; raise RecordingError if it is unreadable."""
    try:
        if path.suffix == PARTIAL_SUFFIX:
            os.close(claim(path, os.O_RDONLY))
    except BlockingIOError:
        return True
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    return False


def open_recording(path: Path, *, living: bool = False) -> memoryview:
    """Return a recording's bytes.

    Raises
    ------
    RecordingError
        If the file is not a recording, or is being recorded and not ``living``.
    """
    if not living and being_recorded(path):
        raise RecordingError(
            f"{path}: still being recorded; end the episode or stop the recorder first"
        )
    try:
        data = mapped(path)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    if not data:
        raise RecordingError(f"{path}: empty")
    if data[: len(MAGIC)] != MAGIC:
        raise RecordingError(f"{path}: not an MCAP file")
    return data


class StoredMessage(NamedTuple):
    """A message of a recording before decoding; tick and stamp are those of its record."""

    key: str
    topic: Topic | None  # None for a foreign key, which has no robot and no episode.
    robot: str
    episode: str
    tick: int
    stamp_ns: int
    payload: memoryview

    def message(self, *, pixels: bool = False) -> Message:
        """Decode the message and its ``pixels``; raise ValueError if it does not match its channel."""
        if self.topic is None:
            raise ValueError(f"unknown topic {self.key}")
        payload = copied(self.payload)
        try:
            message = (
                self._image(payload)
                if self.topic is JPEG
                else self.topic.message.model_validate_json(payload)
            )
        except ValidationError as error:
            raise ValueError(describe(error)) from None
        if (message.robot, message.episode, message.topic_name) != (
            self.robot,
            self.episode,
            self.topic.name,
        ):
            raise ValueError("robot, episode or topic differs from its channel")
        if pixels and isinstance(message, CompressedImage):
            decode_jpeg(message.data)
        return message

    def _image(self, payload: bytes) -> CompressedImage:
        _, jpeg = stamped_jpeg(payload)
        width, height = jpeg_size(jpeg) or (0, 0)
        if not width * height:
            raise ValueError("not a JPEG image")
        header = Message(
            robot=self.robot, episode=self.episode, tick=self.tick, stamp_ns=self.stamp_ns
        )
        return CompressedImage.after(header, width=width, height=height, data=jpeg)


def messages(every: Iterable[McapRecord]) -> Iterator[StoredMessage]:
    """Yield the messages among the records of a file, including foreign messages."""
    channels: dict[int, tuple[str, Topic | None, str, str]] = {}
    for record in every:
        if isinstance(record, Channel):
            robot = record.metadata.get("robot", "")
            episode = record.metadata.get("episode", "")
            named = re.fullmatch(ROBOT_ID_PATTERN, robot) and re.fullmatch(
                EPISODE_ID_PATTERN, episode
            )
            channels[record.id] = (
                record.topic,
                topic_of(record.topic) if named else None,
                robot,
                episode,
            )
        elif isinstance(record, MessageRecord) and record.channel_id in channels:
            whose = channels[record.channel_id]
            yield StoredMessage(*whose, record.sequence, record.log_time, memoryview(record.data))


def messages_of(
    path: Path, topics: Collection[Topic], allowance: Allowance | None = None
) -> Iterator[StoredMessage]:
    """Yield the messages of some topics in a recording, within an ``allowance``.

    Raises
    ------
    RecordingError
        If the file cannot be read, is damaged, or takes too much memory.
    """
    data = open_recording(path)
    allowance = allowance or Allowance()
    before = allowance.left
    try:
        for stored in messages(records(data, allowance)):
            if stored.topic in topics:
                allowance.take(OBJECTS)
                yield stored
    except MemoryLimitError as error:
        allowance.left = before
        raise RecordingError(
            f"{path}: {error}; unpack it first (mcap decompress), or read fewer at once"
        ) from None
    except UNREADABLE as error:
        why = f"damaged: {str(error) or type(error).__name__}; see smal recording repair"
        raise RecordingError(f"{path}: {why}") from None
