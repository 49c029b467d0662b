"""One episode's recording, from its first message to its seal."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final, Self

from mcap.records import Message as StoredMessage

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import key_of, topic_of
from services.kit.version import program_version
from services.recordings.encoding import ChannelFormat, format_of, payload_of, protobuf_format
from services.recordings.growing import GrowingFile
from services.recordings.ledger import Ledger, order_of
from services.recordings.sink import Sink, claim, free_path, partial_of, publish
from services.recordings.views import View, Views, view_key

#: Names of the metadata records: what the episode is (written first), and what the recording lacks (written last).
EPISODE_METADATA: Final = "smal.episode"
GAPS_METADATA: Final = "smal.gaps"


class EpisodeWriter:
    """Writes the messages of one episode.

    The file is called ``<episode>.mcap.partial`` until it is sealed. Every message is whole in it when ``write``
    returns, see `services.recordings.growing`: nothing is lost in a crash, and viewers have an index to seek by.

    Parameters
    ----------
    part
        The file that is written.
    path
        Name of the recording once it is sealed.
    metadata
        What the episode is, its robot and id included.

    Raises
    ------
    OSError
        When the file cannot be made.
    """

    def __init__(self, part: Path, path: Path, metadata: dict[str, str]) -> None:
        self.path = path
        self.ledger = Ledger()
        self.messages = 0
        self.end_tick: int | None = None
        self.problem: str | None = None
        self._part = part
        self._metadata = metadata
        self._views = Views()
        self._channels: dict[tuple[str, ChannelFormat], int] = {}
        self._schemas: dict[ChannelFormat, int] = {}
        self._sink = Sink(claim(part, os.O_RDWR | os.O_CREAT | os.O_EXCL))
        self._file = GrowingFile(self._sink)
        try:
            self._file.begin(f"smal {program_version()}")
            self._file.add_metadata(EPISODE_METADATA, metadata)
        except OSError:
            self._sink.close()
            part.unlink(missing_ok=True)
            raise

    @classmethod
    def begin(cls, folder: Path, started: Episode) -> Self:
        """Make the file of an episode that begins with this event.

        Raises
        ------
        OSError
            When the file cannot be made.
        """
        path = free_path(folder, started.episode)
        return cls(partial_of(path), path, _description(started))

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._sink.tell()

    def write(self, message: Message) -> None:
        """Write a message, if it is new.

        Raises
        ------
        OSError
            When it cannot be written, for example because the disk is full; the file then takes no more.
        """
        if self.problem is None and self.ledger.admit(message.topic_name, order_of(message)):
            key, form = key_of(message), format_of(type(message))
            self._append(key, form, message.stamp_ns, message.tick, payload_of(message), message)

    def seal(self) -> Path:
        """Finish the recording, and give it its name.

        Returns
        -------
        Path
            The recording. Where there was no room for its end it is what `services.recordings.leftover` seals later.
        """
        try:
            if self.problem is None:
                self._finish()
                publish(self._part, self.path)
                return self.path
        except OSError as error:
            self.problem = error.strerror or str(error)
        finally:
            self._sink.close()
        return self._part

    def copy(self, key: str, form: ChannelFormat, stored: StoredMessage, message: Message | None) -> None:
        """Write a message of another recording, if it is new; of an image, which is the same in all, no message.

        Raises
        ------
        OSError
            As of `write`.
        """
        topic = topic_of(key)
        if topic is None:
            raise ValueError(key)
        order = (stored.sequence, 0) if message is None else order_of(message)
        if self.problem is None and self.ledger.admit(topic.name, order):
            self._append(key, form, stored.log_time, stored.sequence, bytes(stored.data), message)

    def _append(
        self, key: str, form: ChannelFormat, stamp_ns: int, tick: int, payload: bytes, message: Message | None
    ) -> None:
        self._file.add_message(self._channel(key, form), stamp_ns, tick, payload)
        for view in () if message is None else self._views.of(message):
            self._add_view(view, stamp_ns, tick)
        try:
            self._file.write()
        except OSError as error:
            self.problem = error.strerror or str(error)
            raise
        self.messages += 1
        if isinstance(message, Episode) and message.event == "ended":
            self.end_tick = message.tick

    def _add_view(self, view: View, stamp_ns: int, tick: int) -> None:
        form = protobuf_format(type(view.message))  # type: ignore[arg-type]  # a class is hashable
        channel = self._channel(view_key(self._metadata["robot"], view.name), form)
        self._file.add_message(channel, stamp_ns, tick, view.message.SerializeToString())

    def _finish(self) -> None:
        if self.end_tick is not None:
            self.ledger.close(self.end_tick)
        notes = {"duplicates": str(self.ledger.duplicates)} | self.ledger.gaps()
        self._file.add_metadata(GAPS_METADATA, notes)
        # Behind it, in a chunk of its own: it has the time of the beginning.
        way = list(self._views.way())
        for cause, view in way:
            self._add_view(view, cause.stamp_ns, cause.tick)
        if way:
            self._file.write()
        self._file.finish()

    def _channel(self, key: str, form: ChannelFormat) -> int:
        channel = self._channels.get((key, form))
        if channel is None:
            if form not in self._schemas:
                self._schemas[form] = self._file.add_schema(form.schema_name, form.schema_encoding, form.schema)
            ids = {name: self._metadata[name] for name in ("robot", "episode")}
            channel = self._file.add_channel(key, form.message_encoding, self._schemas[form], ids)
            self._channels[key, form] = channel
        return channel


def _description(started: Episode) -> dict[str, str]:
    return {
        "robot": started.robot,
        "episode": started.episode,
        "world": started.world,
        "seed": str(started.seed),
        "purpose": started.purpose,
        "goal": started.goal,
        "driver": started.driver,
        "software": program_version(),
        "recorded_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
