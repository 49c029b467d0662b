"""Writer of the recording of an episode."""

import os
import sys
import time
from pathlib import Path
from typing import Any, Final, Self, cast

from mcap.writer import CompressionType, Writer

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import key_of
from services.kit.version import program_version
from services.recordings.encoding import ChannelFormat, format_of, payload_of, protobuf_format
from services.recordings.ledger import Ledger
from services.recordings.sink import Sink, claim, free_path, partial_of, publish
from services.recordings.views import RecordedView, Views, view_key

#: Names of the metadata records: the episode (written first) and its gaps (written last).
EPISODE_METADATA: Final = "smal.episode"
GAPS_METADATA: Final = "smal.gaps"
#: Duration of a chunk: viewers load whole chunks, and a crash or a wrong byte costs a chunk.
_CHUNK_NS: Final = 1_000_000_000
#: Largest chunk, for large images, which stay in memory until it is written.
_CHUNK_BYTES: Final = 4 * 2**20


class EpisodeWriter:
    """Writes the messages of one episode.

    The file is named ``<episode>.mcap.partial`` until it is sealed. It grows by a chunk for each
    second of messages, and with `flush`: a crash loses the messages since then. Raises OSError if
    the file ``part`` cannot be created. ``metadata`` describes the episode, with its robot and id.
    """

    def __init__(self, part: Path, path: Path, metadata: dict[str, str]) -> None:
        self.path = path
        self.ledger = Ledger()
        self.messages = self._written = 0  # Number of accepted messages.
        self.end_tick: int | None = None  # Last tick of the episode.
        self.problem: str | None = None  # Reason to accept no more messages.
        self._part = part
        self._ids = {name: metadata[name] for name in ("robot", "episode")}
        self._views = Views()
        self._channels: dict[tuple[str, ChannelFormat], int] = {}
        self._schemas: dict[ChannelFormat, int] = {}
        #: Bytes and first time of the waiting chunk.
        self._bytes = 0
        self._first_ns = sys.maxsize
        self._sink = Sink(claim(part, os.O_RDWR | os.O_CREAT | os.O_EXCL))
        try:
            self._file: Any = Writer(
                cast("Any", self._sink), sys.maxsize, CompressionType.NONE, enable_data_crcs=True
            )
            self._file.start(library=f"smal {program_version()}")
            self._file.add_metadata(EPISODE_METADATA, metadata)
        except OSError:
            self._sink.close()
            part.unlink(missing_ok=True)
            raise

    @classmethod
    def begin(cls, folder: Path, started: Episode) -> Self:
        """Create the file of an episode from its first event; raise OSError if that fails."""
        path = free_path(folder, started.episode)
        names = ("robot", "episode", "world", "seed", "purpose", "goal", "driver")
        metadata = {name: str(getattr(started, name)) for name in names}
        recorded_utc = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        return cls(
            partial_of(path),
            path,
            metadata | {"software": program_version(), "recorded_utc": recorded_utc},
        )

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._sink.tell()

    @property
    def waiting(self) -> int:
        """Number of messages not yet in the file."""
        return self.messages - self._written

    def write(self, message: Message) -> None:
        """Write a message if it is new; after an OSError (disk full) reject all messages."""
        if self.problem is not None or not self.ledger.admit(message):
            return
        self._add(key_of(message), format_of(type(message)), message, payload_of(message))
        for view in self._views.of(message):
            self._draw(view, message)
        self.messages += 1
        if isinstance(message, Episode) and message.event == "ended":
            self.end_tick = message.tick
        self._first_ns = min(self._first_ns, message.stamp_ns)
        if message.stamp_ns - self._first_ns >= _CHUNK_NS or self._bytes >= _CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the waiting messages; raise errors as `write` does."""
        before = self._sink.tell()
        try:
            self._file.flush()
        except OSError as error:
            self.problem = error.strerror or str(error)
            # Chunk and index are separate writes: without space for the index, the chunk is
            # complete.
            if self._sink.tell() > before:
                self._written = self.messages
            raise
        self._written = self.messages
        self._bytes = 0
        self._first_ns = sys.maxsize

    def seal(self) -> Path:
        """Complete and name the recording; without space for its end, `leftover` seals it later."""
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

    def _finish(self) -> None:
        self.flush()
        if self.end_tick is not None:
            self.ledger.close(self.end_tick)
        self._file.add_metadata(
            GAPS_METADATA, {"duplicates": str(self.ledger.duplicates)} | self.ledger.gaps()
        )
        # After the messages, in a separate chunk: it has the time of the first message.
        for cause, view in self._views.way():
            self._draw(view, cause)
        self._file.finish()
        self._sink.sync()

    def _draw(self, view: RecordedView, cause: Message) -> None:
        form = protobuf_format(type(view.message))  # type: ignore[arg-type]  # a class is hashable
        self._add(view_key(cause.robot, view.name), form, cause, view.message.SerializeToString())

    def _add(self, key: str, form: ChannelFormat, cause: Message, payload: bytes) -> None:
        channel = self._channels.get((key, form))
        if channel is None:
            if form not in self._schemas:
                self._schemas[form] = self._file.register_schema(
                    form.schema_name, form.schema_encoding, form.schema
                )
            channel = self._file.register_channel(
                key, form.message_encoding, self._schemas[form], self._ids
            )
            self._channels[key, form] = channel
        self._bytes += len(payload)
        self._file.add_message(channel, cause.stamp_ns, payload, cause.stamp_ns, cause.tick)
