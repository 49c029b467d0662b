"""An MCAP file that grows: whole at every moment, and at its end in chunks, with the index by which viewers seek.

Every message stands in the file as soon as it is written, behind a place kept free for the head of a chunk. When a
second of messages is there, the head is put into that place and makes a chunk of them. So a process that is killed
loses nothing, a viewer of a file of hours has an index that it can hold, and the writer holds 0.3 kB for every second.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from typing import Final, cast

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from services.recordings.records import CHUNK_HEAD, KEPT_FREE, MAGIC
from services.recordings.sink import Sink

#: A chunk is complete when its messages span a second: what viewers load at least, and what one wrong byte costs.
_CHUNK_NS: Final = 1_000_000_000
#: Or when it has so many bytes, where images are large: this process holds them until then.
_CHUNK_BYTES: Final = 4 * 2**20
#: A record that all readers pass over, as long as the head of a chunk.
_FREE: Final = struct.pack("<BQ40x", KEPT_FREE, CHUNK_HEAD.size - 9)


def raw(record: McapRecord) -> bytes:
    """Return the bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    return cast("bytes", builder.end())  # type: ignore[no-untyped-call]


@dataclass
class OpenChunk:
    """What is written behind a place kept free.

    Attributes
    ----------
    at
        Where that place is in the file.
    content
        The records behind it.
    entries
        Time and offset in the content of each message, by channel.
    first_ns, last_ns
        Times of the first and the last message.
    """

    at: int
    content: bytearray = field(default_factory=bytearray)
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    first_ns: int = 2**63
    last_ns: int = 0

    def note(self, channel: int, stamp_ns: int, offset: int) -> None:
        """Take note of a message in the content."""
        self.entries.setdefault(channel, []).append((stamp_ns, offset))
        self.first_ns, self.last_ns = min(self.first_ns, stamp_ns), max(self.last_ns, stamp_ns)


@dataclass
class Index:
    """What the end of a file says of it.

    Attributes
    ----------
    schemas, channels
        All of them, by their numbers.
    metadata
        Where these records are.
    counts
        Messages by channel.
    first_ns, last_ns
        Times of the first and the last message.
    chunks
        How many there are.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    first_ns: int = 2**63
    last_ns: int = 0
    chunks: int = 0
    #: As bytes, a tenth of what the records themselves would take.
    _chunk_indexes: bytearray = field(default_factory=bytearray)

    @property
    def size(self) -> int:
        """Bytes that it takes at least."""
        return len(self._chunk_indexes)

    def add(self, chunk: ChunkIndex, counts: Counter[int]) -> None:
        """Add a chunk, and how many messages it has by channel."""
        self.counts += counts
        self.first_ns = min(self.first_ns, chunk.message_start_time)
        self.last_ns = max(self.last_ns, chunk.message_end_time)
        self.chunks += 1
        self._chunk_indexes += raw(chunk)

    def written(self, at: int) -> bytes:
        """Return all that follows the end of the data, which is there in the file."""
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self.chunks,
            message_count=self.counts.total(),
            message_end_time=self.last_ns,
            message_start_time=min(self.first_ns, self.last_ns),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )
        groups = (
            (Opcode.SCHEMA, b"".join(map(raw, self.schemas.values()))),
            (Opcode.CHANNEL, b"".join(map(raw, self.channels.values()))),
            (Opcode.STATISTICS, raw(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.METADATA_INDEX, b"".join(map(raw, self.metadata))),
        )
        summary, offsets = bytearray(), b""
        for opcode, content in groups:
            offsets += raw(SummaryOffset(group_opcode=opcode, group_start=at + len(summary), group_length=len(content)))
            summary += content
        footer = Footer(summary_start=at, summary_offset_start=at + len(summary), summary_crc=0)
        summary += offsets
        # The checksum is of everything before itself.
        footer.summary_crc = zlib.crc32(raw(footer)[:-4], zlib.crc32(summary))
        return bytes(summary) + raw(footer) + MAGIC


class GrowingFile:
    """Writes records to a sink.

    Parameters
    ----------
    sink
        The file.
    index
        What is in it already; nothing if not given.
    chunk
        What is in it behind the last chunk.
    checksum
        Of what is in it before that; None where that is not known.
    """

    def __init__(
        self, sink: Sink, index: Index | None = None, chunk: OpenChunk | None = None, checksum: int | None = 0
    ) -> None:
        self._sink = sink
        self.index = index or Index()
        self._chunk = chunk
        self._checksum = checksum
        self._waiting = bytearray()
        self._noted: list[tuple[int, int, int]] = []

    def begin(self, library: str) -> None:
        """Write what a file begins with; OSError as of the sink, here and below."""
        self._put(MAGIC + raw(Header("", library)))

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a record of names and values."""
        self._close_chunk()
        record = raw(Metadata(name=name, metadata=values))
        at = self._sink.tell()
        self._put(record)
        self.index.metadata.append(MetadataIndex(offset=at, length=len(record), name=name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema to what is written next; return its number."""
        number = len(self.index.schemas) + 1
        self.index.schemas[number] = schema = Schema(id=number, name=name, encoding=encoding, data=data)
        self._waiting += raw(schema)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel to what is written next; return its number."""
        number = len(self.index.channels) + 1
        self.index.channels[number] = channel = Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=metadata
        )
        self._waiting += raw(channel)
        return number

    def add_message(self, channel: int, stamp_ns: int, tick: int, data: bytes) -> None:
        """Add a message to what is written next."""
        self._noted.append((channel, stamp_ns, len(self._waiting)))
        self._waiting += raw(
            Message(channel_id=channel, log_time=stamp_ns, publish_time=stamp_ns, sequence=tick, data=data)
        )

    def write(self) -> None:
        """Write what was added, at once."""
        records, self._waiting = bytes(self._waiting), bytearray()
        noted, self._noted = self._noted, []
        chunk = self._chunk or OpenChunk(self._sink.tell())
        self._sink.write(records if self._chunk else _FREE + records)
        self._chunk = chunk
        for channel, stamp_ns, at in noted:
            chunk.note(channel, stamp_ns, len(chunk.content) + at)
        chunk.content += records
        if chunk.last_ns - chunk.first_ns >= _CHUNK_NS or len(chunk.content) >= _CHUNK_BYTES:
            self._close_chunk()

    def finish(self) -> None:
        """Write the end of the file, and wait until all of it is on the disk."""
        self._close_chunk()
        self._sink.write(raw(DataEnd(self._checksum or 0)))
        self._sink.write(self.index.written(self._sink.tell()))
        self._sink.sync()

    def _close_chunk(self) -> None:
        if self._chunk is None:
            return
        chunk, at = self._chunk, self._sink.tell()
        offsets, indexes = {}, b""
        for channel, entries in chunk.entries.items():
            offsets[channel] = at + len(indexes)
            indexes += raw(MessageIndex(channel_id=channel, records=entries))
        size = len(chunk.content)
        length = CHUNK_HEAD.size + size
        head = CHUNK_HEAD.pack(
            Opcode.CHUNK, length - 9, chunk.first_ns, chunk.last_ns, size, zlib.crc32(chunk.content), 0, size
        )
        # What makes it a chunk comes last: killed before, it is still what it was.
        self._sink.write(indexes)
        self._sink.overwrite(chunk.at, head)
        self._chunk = None
        for part in (head, chunk.content, indexes):
            self._sum(part)
        self.index.add(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=chunk.at,
                compression="",
                compressed_size=size,
                message_end_time=chunk.last_ns,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=chunk.first_ns,
                uncompressed_size=size,
            ),
            Counter({channel: len(entries) for channel, entries in chunk.entries.items()}),
        )

    def _put(self, data: bytes) -> None:
        self._sink.write(data)
        self._sum(data)

    def _sum(self, data: bytes | bytearray) -> None:
        if self._checksum is not None:
            self._checksum = zlib.crc32(data, self._checksum)
