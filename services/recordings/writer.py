"""One episode's MCAP file, from its first message to its seal."""

from __future__ import annotations

import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, Self, cast

from mcap.writer import CompressionType, Writer

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import TOPICS, key_of
from services.recordings.contents import Contents, end_tick_of
from services.recordings.encoding import format_of, payload_of
from services.recordings.ledger import Ledger
from services.recordings.recovery import RecoveryError, Unfinished, finish, finished
from services.recordings.sink import Sink, free_path, partial_of, publish

#: Names of the metadata records: what the episode is (written first), and what the recording lacks (written last).
EPISODE_METADATA: Final = "smal.episode"
GAPS_METADATA: Final = "smal.gaps"


class EpisodeWriter:
    """Writes the messages of one episode.

    The file is called ``<episode>.mcap.partial`` until it is sealed. Every message is a chunk of its own, uncompressed,
    and whole in the file when ``write`` returns. Bigger chunks would be lost in a crash; without any, a viewer has no
    index to seek by, and Foxglove refuses more than 1 GB.

    Parameters
    ----------
    sink, writer
        The file, and what writes its records.
    path
        Name of the file once it is sealed.
    metadata
        Robot and episode.
    """

    def __init__(self, sink: Sink, writer: Writer, path: Path, metadata: dict[str, str]) -> None:
        self.path = path
        self.ledger = Ledger()
        self.messages = 0
        self.end_tick: int | None = None
        self.problem: str | None = None
        self._partial = sink.path
        self._sink = sink
        self._writer = writer
        self._metadata = metadata
        self._channels: dict[str, int] = {}
        self._schemas: dict[type[Message], int] = {}
        self._whole = sink.tell()

    @classmethod
    def begin(cls, folder: Path, started: Episode) -> Self:
        """Make the file of an episode that begins with this event.

        Raises
        ------
        OSError
            When the file cannot be made.
        """
        path = free_path(folder, started.episode)
        metadata = {"robot": started.robot, "episode": started.episode}
        sink = Sink(partial_of(path))
        try:
            # The writer asks its output for no more than write, tell and flush.
            writer = Writer(cast("Any", sink), compression=CompressionType.NONE)
            writer.start(profile="", library=f"smal {_software()}")
            writer.add_metadata(EPISODE_METADATA, metadata | _description(started))
        except OSError:
            sink.close()
            sink.path.unlink(missing_ok=True)
            raise
        return cls(sink, writer, path, metadata)

    @classmethod
    def resume(cls, partial: Path) -> Self:
        """Go on with a file whose recorder was killed, after its last whole message.

        Raises
        ------
        RecoveryError
            When it cannot be gone on with.
        OSError
            When it cannot be opened, or another recorder writes it.
        """
        sink = Sink(partial, new=False)
        try:
            unfinished = Unfinished.read(sink.fileno())
            contents = Contents.of(unfinished.records())
            unfinished.go_on(sink)
        except BaseException:
            sink.close()
            raise
        resumed = cls(sink, unfinished.writer, finished(partial), contents.metadata)
        resumed._remember(contents)
        return resumed

    def _remember(self, contents: Contents) -> None:
        for topic, channel in contents.channels.items():
            self._channels[topic] = channel.id
            self._schemas[TOPICS[topic].message] = channel.schema_id
        for topic, order in contents.orders:
            self.ledger.enter(topic, order)
            self.messages += 1
        self.end_tick = contents.end_tick

    @property
    def episode(self) -> str:
        """Id of the episode."""
        return self._metadata["episode"]

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._whole

    def write(self, message: Message) -> None:
        """Write a message, if it is new.

        Raises
        ------
        OSError
            When it cannot be written, for example because the disk is full; the file is then cut after the last
            whole message and takes no more.
        """
        if self.problem is not None or not self.ledger.admit(message):
            return
        payload = payload_of(message)
        try:
            self._writer.add_message(self._channel(message), message.stamp_ns, payload, message.stamp_ns, message.tick)
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            self.problem = error.strerror or str(error)
            raise
        self._whole = self._sink.tell()
        self.messages += 1
        self.end_tick = end_tick_of(message, self.end_tick)

    def seal(self) -> Path:
        """Finish the file and give it its name.

        Returns
        -------
        Path
            The recording. It still has the name of an unfinished one if there is no room even for the index; the next
            recorder that starts in this folder finishes it then.
        """
        if self.end_tick is not None:
            self.ledger.close(self.end_tick)
        try:
            self._finish()
            publish(self._partial, self.path)
        except OSError as error:
            self.problem = self.problem or error.strerror or str(error)
            return self._partial
        finally:
            self._sink.close()
        return self.path

    def _finish(self) -> None:
        if self.problem is None:
            try:
                notes = {"duplicates": str(self.ledger.duplicates)} | self.ledger.gaps()
                self._writer.add_metadata(GAPS_METADATA, notes)
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._sink.sync()
            except OSError as error:
                self.problem = error.strerror or str(error)
            else:
                return
        # What the writer believes to have written is not what stands in the file: index what does.
        self._sink.truncate(self._whole)
        try:
            finish(self._sink.fileno())
        except RecoveryError as error:
            raise OSError(str(error)) from None

    def _channel(self, message: Message) -> int:
        topic, kind = message.topic_name, type(message)
        channel = self._channels.get(topic)
        if channel is None:
            form = format_of(kind)
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(form.schema_name, form.schema_encoding, form.schema)
            channel = self._writer.register_channel(
                key_of(message), form.message_encoding, self._schemas[kind], self._metadata
            )
            self._channels[topic] = channel
        return channel


def _description(started: Episode) -> dict[str, str]:
    return {
        "world": started.world,
        "seed": str(started.seed),
        "purpose": started.purpose,
        "goal": started.goal,
        "driver": started.driver,
        "software": _software(),
        "recorded_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _software() -> str:
    try:
        return version("smal")
    except PackageNotFoundError:
        return "unknown"
