"""One episode's recording, from its first message to its seal."""

from __future__ import annotations

import os
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Self, cast

from mcap.exceptions import McapError
from mcap.records import Channel, Metadata, Schema
from mcap.records import Message as StoredMessage
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import key_of, topic_of
from services.kit.version import program_version
from services.recordings.encoding import ChannelFormat, format_of, payload_of, protobuf_format
from services.recordings.ledger import ORDERED, Ledger, order_of
from services.recordings.records import MAGIC, mapped, records, surveyed
from services.recordings.sink import Sink, claim, finished, free_path, next_part, partial_of, parts_of, publish
from services.recordings.views import View, Views, is_view, view_key

#: Names of the metadata records: what the episode is (written first), and what the recording lacks (written last).
EPISODE_METADATA: Final = "smal.episode"
GAPS_METADATA: Final = "smal.gaps"
#: What is raised where a file holds something else than it should.
_DAMAGED: Final = (McapError, ValueError, KeyError, struct.error)


class RecoveryError(Exception):
    """What a killed recorder left cannot be gone on with; the text says why in one line."""


class EpisodeWriter:
    """Writes the messages of one episode.

    The file is called ``<episode>.mcap.partial`` until it is sealed. Every message is a chunk of its own, uncompressed,
    and whole in the file when ``write`` returns. Bigger chunks would be lost in a crash; without any, a viewer has no
    index to seek by, and Foxglove refuses more than 1 GB.

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
        self._sink = Sink(part)
        #: The first part and its lock, where this is a later one.
        self._first: tuple[Path, int] | None = None
        try:
            # The writer asks its output for no more than write, tell and flush.
            self._writer = Writer(cast("Any", self._sink), compression=CompressionType.NONE, enable_data_crcs=True)
            self._writer.start(profile="", library=f"smal {program_version()}")
            self._writer.add_metadata(EPISODE_METADATA, metadata)
        except OSError:
            self._discard()
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

    @classmethod
    def resume(cls, partial: Path) -> Self:
        """Go on, in another part, with a recording whose recorder was killed.

        Raises
        ------
        RecoveryError
            When it is not the recording of an episode.
        OSError
            When it cannot be opened, another recorder writes it, or no other part can be made.
        """
        lock = claim(partial)
        try:
            writer = cls(next_part(partial), finished(partial), metadata_of(partial))
        except BaseException:
            os.close(lock)
            raise
        writer._first = partial, lock
        return writer

    @property
    def episode(self) -> str:
        """Id of the episode."""
        return self._metadata["episode"]

    @property
    def resumed(self) -> bool:
        """Whether it goes on with what a killed recorder left."""
        return self._first is not None

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
        if self.problem is not None or not self.ledger.admit(message.topic_name, order_of(message)):
            return
        stamp_ns, tick = message.stamp_ns, message.tick
        try:
            self._append(key_of(message), format_of(type(message)), stamp_ns, tick, payload_of(message), message)
        except OSError as error:
            self.problem = error.strerror or str(error)
            raise
        self._note_end(message)

    def seal(self) -> Path:
        """Finish the recording, make its parts one file, and give it its name.

        Returns
        -------
        Path
            The recording. Where there was no room it is still unfinished, with all its parts; ``resume`` and ``seal``
            finish it later.
        """
        first, lock = self._first or (self._part, None)
        whole = self
        try:
            if self.problem is not None:
                return first
            if lock is None:
                self._finish()
            else:
                whole = self._merged(first)
                for part in parts_of(first)[1:]:
                    part.unlink()
            publish(first, self.path)
        except (OSError, RecoveryError) as error:
            self.problem = getattr(error, "strerror", None) or str(error)
            if not self.messages and lock is not None:
                self._part.unlink(missing_ok=True)
            return first
        finally:
            for sink in {self._sink, whole._sink}:
                sink.close()
            if lock is not None:
                os.close(lock)
        self.ledger, self.messages, self._sink, self._first = whole.ledger, whole.messages, whole._sink, None
        return self.path

    def _merged(self, first: Path) -> Self:
        """Put all parts as one finished file in the place of the first, which at no time lacks what another had.

        It begins as one more part: should the process be killed, it will be merged like the others.
        """
        parts = parts_of(first)
        merged = type(self)(next_part(first), self.path, self._metadata)
        try:
            for part in parts:
                merged._take(part)
            merged._finish()
            publish(merged._part, first)
        except BaseException:
            merged._discard()
            raise
        return merged

    def _take(self, part: Path) -> None:
        """Write what another part has and this one has not."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[str, ChannelFormat]] = {}
        views: set[int] = set()
        try:
            for record in surveyed(mapped(part), lambda _damage: None):
                match record:
                    case Schema():
                        schemas[record.id] = record
                    case Channel() if is_view(record.topic):
                        views.add(record.id)
                    case Channel():
                        if record.metadata != self._channel_metadata:
                            raise ValueError("of another episode")
                        schema = schemas[record.schema_id]
                        form = ChannelFormat(schema.name, schema.encoding, record.message_encoding, bytes(schema.data))
                        channels[record.id] = record.topic, form
                    case StoredMessage() if record.channel_id not in views:
                        self.copy(*channels[record.channel_id], record)
        except _DAMAGED:
            raise RecoveryError(f"{part.name} is not the recording of an episode") from None

    def copy(self, key: str, form: ChannelFormat, stored: StoredMessage) -> None:
        """Write a message of another recording, if it is new.

        Raises
        ------
        ValueError
            When it is none of ours.
        OSError
            When it cannot be written.
        """
        topic = topic_of(key)
        if topic is None:
            raise ValueError(key)
        payload = bytes(stored.data)
        order: tuple[int, ...] = (stored.sequence,)
        message: Message | None = None
        if issubclass(topic.message, ORDERED):
            message = topic.message.model_validate_json(payload)
            order = order_of(message)
            self._note_end(message)
        elif self._views.derives_from(topic.message):
            # What does not decode is kept as it is; it is only not drawn.
            with suppress(ValidationError):
                message = topic.message.model_validate_json(payload)
        if self.ledger.admit(topic.name, order):
            self._append(key, form, stored.log_time, stored.sequence, payload, message)

    def _append(
        self, key: str, form: ChannelFormat, stamp_ns: int, tick: int, payload: bytes, message: Message | None
    ) -> None:
        self._writer.add_message(self._channel(key, form), stamp_ns, payload, stamp_ns, tick)
        for view in () if message is None else self._views.of(message):
            self._append_view(view, stamp_ns, tick)
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.messages += 1

    def _append_view(self, view: View, stamp_ns: int, tick: int) -> None:
        form = protobuf_format(type(view.message))  # type: ignore[arg-type]  # a class is hashable
        channel = self._channel(view_key(self._metadata["robot"], view.name), form)
        self._writer.add_message(channel, stamp_ns, view.message.SerializeToString(), stamp_ns, tick)

    def _note_end(self, message: Message) -> None:
        if isinstance(message, Episode) and message.event == "ended":
            self.end_tick = message.tick

    def _finish(self) -> None:
        if self.end_tick is not None:
            self.ledger.close(self.end_tick)
        for cause, view in self._views.way():
            self._append_view(view, cause.stamp_ns, cause.tick)
        notes = {"duplicates": str(self.ledger.duplicates)} | self.ledger.gaps()
        self._writer.add_metadata(GAPS_METADATA, notes)
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._sink.sync()

    def _discard(self) -> None:
        self._sink.close()
        self._part.unlink(missing_ok=True)

    @property
    def _channel_metadata(self) -> dict[str, str]:
        return {name: self._metadata[name] for name in ("robot", "episode")}

    def _channel(self, key: str, form: ChannelFormat) -> int:
        channel = self._channels.get((key, form))
        if channel is None:
            if form not in self._schemas:
                self._schemas[form] = self._writer.register_schema(form.schema_name, form.schema_encoding, form.schema)
            channel = self._writer.register_channel(
                key, form.message_encoding, self._schemas[form], self._channel_metadata
            )
            self._channels[key, form] = channel
        return channel


def metadata_of(partial: Path) -> dict[str, str]:
    """Return what a leftover says of its episode."""
    data = mapped(partial)
    if MAGIC.startswith(bytes(data[: len(MAGIC) + 1])):
        partial.unlink()
        raise RecoveryError("it was empty and is removed")
    try:
        for record in records(data):
            if isinstance(record, Metadata) and record.name == EPISODE_METADATA:
                return {"robot": record.metadata["robot"], "episode": record.metadata["episode"]} | record.metadata
    except _DAMAGED:
        pass
    raise RecoveryError("it is not the recording of an episode")


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
