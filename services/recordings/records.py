"""The records of an MCAP file, one after the other: files may be cut off, damaged, or made to do harm.

The reader of the ``mcap`` package bounds neither what chunks unpack to nor how many records are in them, and it reads
every image. So it decodes single records only.
"""

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable
from smal.files.container import open_regular

MAGIC: Final = MCAP0_MAGIC  # First and last bytes of every MCAP file.
HEAD: Final = struct.Struct("<BQ")  # Of every record: what it is, and how many bytes follow.
UNREADABLE: Final = (
    McapError,
    ValueError,
    struct.error,
)  # What is raised where there is no record.
#: Most bytes that a packed chunk may unpack to. Other tools make chunks of a few megabytes, and at least of one
#: message; the largest is an image of 17 MB.
LARGEST_CHUNK: Final = 64 * 2**20
#: Most bytes of a record that is taken apart, which takes 15 times as much memory. The largest is the list of what a
#: recording lacks: 12 MB, where every other frame of a day is missing.
_LARGEST_RECORD: Final = 16 * 2**20
#: Most bytes that packed recordings may take in memory. 12 drives of 1024x768 unpack to 1.6 GB; our own recordings are
#: not packed at all, and their images stay on the disk.
MOST_UNPACKED: Final = 4 * 2**30
_MOST_RATIO: Final = 256  # A file may unpack to so many times its size: all that LZ4 can pack.
#: Least bytes of a packed record. A message has another time and number than the last one: with the strongest
#: compression of Zstandard those of a robot that stands, with an exact clock, take 8.8.
_LEAST_RECORD: Final = 4
#: Bytes of a mapped file that may be in memory at once, and how much the system maps round each place that is read.
_RESIDENT = 16 * 2**20
_AROUND = 2**16
#: What is taken apart; the index and all else is passed over.
_KINDS: Final[dict[int, type[Schema | Channel | Metadata]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata,
}  # fmt: skip
_IN_CHUNKS: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_MESSAGE: Final = struct.Struct("<HIQQ")


class MemoryLimitError(McapError):
    """What recordings unpack to takes too much memory; the text says so in one line."""


class Allowance:
    """How much memory all that is read may still take: one image keeps all that its chunk unpacked to."""

    def __init__(self, size: int = MOST_UNPACKED) -> None:
        self.left = size
        self._size = size

    def take(self, size: int) -> None:
        """Take memory; raises MemoryLimitError when it is too much."""
        if size > self.left:
            raise MemoryLimitError(
                f"takes more than {self._size / 2**30:.3g} GiB of memory, with what was read before"
            )
        self.left -= size


class Bounds:
    """What one file may still unpack to: all that is honest fits, and nothing that takes for ever."""

    def __init__(self, size: int, allowance: Allowance | None = None) -> None:
        self._bytes = _MOST_RATIO * size
        self._records = size // _LEAST_RECORD
        self._allowance = allowance or Allowance()

    def unpack(self, chunk: Chunk) -> bytes:
        """Unpack a chunk, never more of it than it announces; raises McapError when it is too much or damaged."""
        size = chunk.uncompressed_size
        if size > LARGEST_CHUNK:
            raise McapError(f"a chunk of {size} bytes, at most {LARGEST_CHUNK} are read")
        self._bytes -= size
        if self._bytes < 0:
            raise MemoryLimitError(f"unpacks to more than {_MOST_RATIO} times its size")
        self._allowance.take(size)
        try:
            match chunk.compression:
                case "zstd":
                    return ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
                case "lz4":
                    return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
                case other:
                    raise McapError(f"a chunk has the unknown compression {printable(other)}")
        except (ZstdError, RuntimeError, MemoryError) as error:
            raise McapError(f"a chunk cannot be unpacked: {error}") from None

    def count(self) -> None:
        """Count a record of a chunk that was unpacked; raises McapError when there are too many."""
        self._records -= 1
        if self._records < 0:
            raise McapError(f"a record for less than {_LEAST_RECORD} bytes of the file")


class _Mapped(mmap.mmap):
    """A file's bytes, and how much of it was read since all of it was last let go of."""

    touched = 0


def copied(payload: memoryview) -> bytes:
    """Return recorded bytes, of a file that does not fill memory by being read."""
    data = bytes(payload)
    _let_go(payload, len(data) + _AROUND)
    return data


def _let_go(data: memoryview, touched: int) -> None:
    """Let a mapped file out of memory whenever much of it was read; what is wanted again is read again."""
    file = data.obj
    if isinstance(file, _Mapped):
        file.touched += touched
        if file.touched > _RESIDENT:
            file.touched = 0
            file.madvise(mmap.MADV_DONTNEED)


def mapped(path: Path) -> memoryview:
    """Return a file's bytes, of which only those are read that are looked at; OSError when it is no regular file."""
    descriptor = open_regular(path)
    try:
        empty = os.fstat(descriptor).st_size == 0
        return memoryview(b"" if empty else _Mapped(descriptor, 0, access=mmap.ACCESS_READ))
    finally:
        os.close(descriptor)


def records(data: memoryview, allowance: Allowance | None = None) -> Iterator[McapRecord]:
    """Yield the whole records that hold something, those in chunks in their place; one of ``UNREADABLE`` at damage."""
    if data[: len(MAGIC)] != MAGIC:
        raise McapError("not an MCAP file")
    bounds = Bounds(len(data), allowance)
    for opcode, begin, end in heads(data, len(MAGIC)):
        if end > len(data) or opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.CHUNK:
            yield from inside(chunk_of(data[begin:end]), bounds)
            _let_go(data, end - begin)
        elif (record := record_of(opcode, data[begin:end])) is not None:
            yield record


class Head(NamedTuple):
    """What a record is, and where its content begins and ends, which may be behind the end of the file."""

    opcode: int
    begin: int
    end: int


def heads(data: memoryview, at: int) -> Iterator[Head]:
    """Yield the heads of the records from a place on."""
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        head = Head(opcode, at + HEAD.size, at + HEAD.size + length)
        yield head
        at = head.end


def inside(chunk: Chunk, bounds: Bounds, *, checked: bool = False) -> Iterator[McapRecord]:
    """Yield the whole records in a chunk; a checksum counts of a packed one, or if ``checked``. Raises as `records`."""
    content = memoryview(bounds.unpack(chunk) if chunk.compression else chunk.data)
    checked |= bool(chunk.compression)
    if len(content) != chunk.uncompressed_size or (
        checked and chunk.uncompressed_crc not in (0, zlib.crc32(content))
    ):
        raise McapError("the content of a chunk is not what it says")
    for opcode, begin, end in heads(content, 0):
        if opcode not in _IN_CHUNKS:
            raise McapError(f"a record of kind {opcode} in a chunk")
        if chunk.compression:
            bounds.count()
        if end <= len(content):
            yield cast("McapRecord", record_of(opcode, content[begin:end]))


def chunk_of(body: memoryview) -> Chunk:
    """Return a chunk by its head; raises as `records`."""
    return cast("Chunk", Chunk.read(_stream_of(body)))


def record_of(opcode: int, body: memoryview) -> McapRecord | None:
    """Return a record that is no chunk, or None where it holds nothing that is read; raises as `records`."""
    if opcode == Opcode.MESSAGE:
        channel, tick, time, sent = _MESSAGE.unpack_from(body)
        data = cast("bytes", body[_MESSAGE.size :])
        return Message(
            channel_id=channel, sequence=tick, log_time=time, publish_time=sent, data=data
        )
    if opcode == 0:
        raise McapError("a record of no kind")
    if opcode not in _KINDS:
        return None
    if len(body) > _LARGEST_RECORD:
        raise McapError(f"a record of {len(body)} bytes, at most {_LARGEST_RECORD} are read")
    return cast("McapRecord", _KINDS[opcode].read(_stream_of(body)))


def _stream_of(data: memoryview) -> ReadDataStream:
    """Return what the ``mcap`` package reads a record from, which asks its input for no more than to read."""
    return ReadDataStream(cast("Any", _Slices(data)))


class _Slices:
    """Gives slices of a mapping, so that images are not read, and never less than was asked for: that is damage."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._position = 0

    def read(self, length: int) -> memoryview:
        begin = self._position
        end = self._position + length
        if not begin <= end <= len(self._data):
            raise EndOfFile
        self._position = end
        return self._data[begin:end]
