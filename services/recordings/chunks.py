"""A recording as it grows: chunk after chunk, each with a second of messages, and at its end the index for viewers.

The writer of the ``mcap`` package holds 3 kB for every chunk, this one a tenth of that.
"""

import zlib
from collections import Counter
from typing import Final

from mcap import records as mcap
from mcap.data_stream import RecordBuilder

from services.recordings.records import MAGIC
from services.recordings.sink import Sink

#: A chunk is complete when it spans so much: what viewers load at least, and what a kill or one wrong byte costs.
_CHUNK_NS: Final = 1_000_000_000
#: And when it has so many bytes, where images are large: this process holds them until then.
_CHUNK_BYTES: Final = 4 * 2**20


def _raw(*records: mcap.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def bare_end() -> bytes:
    """Return the end of a file without an index, which every reader reads from its beginning."""
    footer = mcap.Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
    return _raw(mcap.DataEnd(0), footer) + MAGIC


class ChunkedFile:
    """Writes records to a sink; raises OSError as that."""

    def __init__(self, sink: Sink, library: str) -> None:
        self._sink = sink
        self._checksum = 0
        self._schemas: dict[int, mcap.Schema] = {}
        self._channels: dict[int, mcap.Channel] = {}
        self._metadata: list[mcap.MetadataIndex] = []
        #: Messages by channel, and when the first and the last of all were.
        self._counts: Counter[int] = Counter()
        self._began_ns, self._ended_ns = 2**63, 0
        self._chunks = 0
        #: As bytes, a tenth of what the records themselves would take.
        self._chunk_indexes = bytearray()
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
        self._metadata.append(mcap.MetadataIndex(offset=self._sink.tell(), length=len(record), name=name))
        self._put(record)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        number = len(self._schemas) + 1
        self._schemas[number] = schema = mcap.Schema(id=number, name=name, encoding=encoding, data=data)
        self._content += _raw(schema)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel; return its number."""
        number = len(self._channels) + 1
        self._channels[number] = channel = mcap.Channel(number, topic, encoding, metadata, schema)
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
        """Write what waits, as a chunk, and behind it an index of each channel's messages."""
        if not self._entries:
            return
        at, size = self._sink.tell(), len(self._content)
        self._put(
            _raw(
                mcap.Chunk(
                    compression="",
                    data=bytes(self._content),
                    message_end_time=self._last_ns,
                    message_start_time=self._first_ns,
                    uncompressed_crc=zlib.crc32(self._content),
                    uncompressed_size=size,
                )
            )
        )
        end, offsets = self._sink.tell(), {}
        for channel, entry in self._entries.items():
            offsets[channel] = self._sink.tell()
            self._put(_raw(entry))
            self._counts[channel] += len(entry.records)
        self._chunk_indexes += _raw(
            mcap.ChunkIndex(
                chunk_length=end - at,
                chunk_start_offset=at,
                compression="",
                compressed_size=size,
                message_end_time=self._last_ns,
                message_index_length=self._sink.tell() - end,
                message_index_offsets=offsets,
                message_start_time=self._first_ns,
                uncompressed_size=size,
            )
        )
        self._began_ns, self._ended_ns = min(self._began_ns, self._first_ns), max(self._ended_ns, self._last_ns)
        self._chunks += 1
        self._clear()

    def finish(self) -> None:
        """Write what waits and the end of the file, and wait until all of it is on the disk."""
        self.flush()
        statistics = mcap.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=self._counts.total(),
            message_end_time=self._ended_ns,
            message_start_time=min(self._began_ns, self._ended_ns),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        data_end = _raw(mcap.DataEnd(self._checksum))
        summary = _raw(*self._schemas.values(), *self._channels.values(), statistics, *self._metadata)
        summary += self._chunk_indexes
        footer = mcap.Footer(summary_start=self._sink.tell() + len(data_end), summary_offset_start=0, summary_crc=0)
        # The checksum is of everything before itself.
        footer.summary_crc = zlib.crc32(_raw(footer)[:-4], zlib.crc32(summary))
        self._sink.write(data_end + summary + _raw(footer) + MAGIC)
        self._sink.sync()

    def _put(self, data: bytes) -> None:
        self._sink.write(data)
        self._checksum = zlib.crc32(data, self._checksum)
