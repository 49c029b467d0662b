"""A recording as it grows: chunk after chunk, each with a second of messages, and at its end the index for viewers.

The writer of the ``mcap`` package holds 3 kB for every chunk, this one a tenth of that; and what a killed recorder left
gets the same end.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from mcap import records as mcap
from mcap.data_stream import RecordBuilder

from services.recordings.records import HEAD, MAGIC
from services.recordings.sink import Sink

#: A chunk is complete when it spans so much: what viewers load at least, and what a kill or one wrong byte costs.
_CHUNK_NS: Final = 1_000_000_000
#: And when it has so many bytes, where images are large: this process holds them until then.
_CHUNK_BYTES: Final = 4 * 2**20
#: Bytes of an index of messages: before its entries, and of each.
_INDEX_HEAD: Final = HEAD.size + 6
_INDEX_ENTRY: Final = 16


def _raw(*records: mcap.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


@dataclass
class Index:
    """What the end of a file says of it: all schemas and channels, where the metadata are, and the chunks."""

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    metadata: list[mcap.MetadataIndex] = field(default_factory=list)
    #: Messages by channel.
    counts: Counter[int] = field(default_factory=Counter)
    first_ns: int = 2**63
    last_ns: int = 0
    chunks: int = 0
    #: As bytes, a tenth of what the records themselves would take.
    _chunk_indexes: bytearray = field(default_factory=bytearray)

    def add_metadata(self, name: str, at: int, size: int) -> None:
        """Add a record of names and values."""
        self.metadata.append(mcap.MetadataIndex(offset=at, length=size, name=name))

    @staticmethod
    def indexes_end(at: int, counts: dict[int, int]) -> int:
        """Return where the indexes of so many messages by channel end, which begin there."""
        return at + sum(_INDEX_HEAD + count * _INDEX_ENTRY for count in counts.values())

    def add_chunk(self, chunk: mcap.Chunk, at: int, size: int, counts: dict[int, int]) -> None:
        """Add a chunk that is not packed, which begins there and has so many bytes.

        Behind it an index of each channel's messages stands, in the order of ``counts``, which says how many.
        """
        offsets, end = {}, at + size
        for channel, count in counts.items():
            offsets[channel] = end
            end = self.indexes_end(end, {channel: count})
        entry = mcap.ChunkIndex(
            chunk_length=size,
            chunk_start_offset=at,
            compression="",
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=end - at - size,
            message_index_offsets=offsets,
            message_start_time=chunk.message_start_time,
            uncompressed_size=len(chunk.data),
        )
        self._chunk_indexes += _raw(entry)
        self.counts.update(counts)
        self.first_ns = min(self.first_ns, chunk.message_start_time)
        self.last_ns = max(self.last_ns, chunk.message_end_time)
        self.chunks += 1

    def end(self, at: int, checksum: int) -> bytes:
        """Return all that follows the data, which end there, of which this is the checksum; 0 if it is not known."""
        statistics = mcap.Statistics(
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
        data_end = _raw(mcap.DataEnd(checksum))
        summary = _raw(*self.schemas.values(), *self.channels.values(), statistics, *self.metadata)
        summary += self._chunk_indexes
        footer = mcap.Footer(summary_start=at + len(data_end), summary_offset_start=0, summary_crc=0)
        # The checksum is of everything before itself.
        footer.summary_crc = zlib.crc32(_raw(footer)[:-4], zlib.crc32(summary))
        return data_end + summary + _raw(footer) + MAGIC


class ChunkedFile:
    """Writes records to a sink; raises OSError as that."""

    def __init__(self, sink: Sink, library: str) -> None:
        self._sink = sink
        self._index = Index()
        self._checksum = 0
        self._put(MAGIC + _raw(mcap.Header("", library)))
        self._clear()

    def _clear(self) -> None:
        self._content = bytearray()
        self._entries: dict[int, mcap.MessageIndex] = {}
        self._first_ns, self._last_ns = 2**63, 0

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a record of names and values."""
        self.flush()
        record = _raw(mcap.Metadata(name=name, metadata=values))
        self._index.add_metadata(name, self._sink.tell(), len(record))
        self._put(record)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        number = len(self._index.schemas) + 1
        self._index.schemas[number] = schema = mcap.Schema(id=number, name=name, encoding=encoding, data=data)
        self._content += _raw(schema)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel; return its number."""
        number = len(self._index.channels) + 1
        self._index.channels[number] = channel = mcap.Channel(number, topic, encoding, metadata, schema)
        self._content += _raw(channel)
        return number

    def add_message(self, channel: int, stamp_ns: int, tick: int, data: bytes) -> None:
        """Add a message."""
        entry = self._entries.setdefault(channel, mcap.MessageIndex(channel, []))
        entry.records.append((stamp_ns, len(self._content)))
        self._first_ns, self._last_ns = min(self._first_ns, stamp_ns), max(self._last_ns, stamp_ns)
        self._content += _raw(mcap.Message(channel, stamp_ns, data, stamp_ns, tick))

    @property
    def is_full(self) -> bool:
        """Whether what waits is enough for a chunk."""
        return self._last_ns - self._first_ns >= _CHUNK_NS or len(self._content) >= _CHUNK_BYTES

    def flush(self) -> None:
        """Write what waits, as a chunk."""
        if not self._entries:
            return
        chunk = mcap.Chunk(
            compression="",
            data=bytes(self._content),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns,
            uncompressed_crc=zlib.crc32(self._content),
            uncompressed_size=len(self._content),
        )
        at, record = self._sink.tell(), _raw(chunk)
        self._put(record + _raw(*self._entries.values()))
        counts = {channel: len(entry.records) for channel, entry in self._entries.items()}
        self._index.add_chunk(chunk, at, len(record), counts)
        self._clear()

    def finish(self) -> None:
        """Write what waits and the end of the file, and wait until all of it is on the disk."""
        self.flush()
        self._sink.write(self._index.end(self._sink.tell(), self._checksum))
        self._sink.sync()

    def _put(self, data: bytes) -> None:
        self._sink.write(data)
        self._checksum = zlib.crc32(data, self._checksum)
