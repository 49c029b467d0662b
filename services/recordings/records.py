"""The records of an MCAP file, one after the other, as far as they are whole."""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, cast

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable
from smal.files.regular_file import open_regular

#: First and last bytes of every MCAP file.
MAGIC: Final = MCAP0_MAGIC
#: Head of a chunk that is not packed: opcode, bytes that follow, times of the first and last message, size, checksum,
#: length of the compression's name, size.
CHUNK_HEAD: Final = struct.Struct("<BQQQQIIQ")
#: Opcode of a place that is kept free for one; those from 0x80 on are left to programs.
KEPT_FREE: Final = 0x80
#: Most bytes that a packed chunk may unpack to. Other tools make chunks of a few megabytes, and at least of one
#: message; the largest is a raw image of 38 MB.
LARGEST_CHUNK: Final = 64 * 2**20
#: Most bytes of a record that is taken apart, which takes 15 times as much memory. The largest is the list of what a
#: recording lacks: 12 MB, where every other frame of a day is missing.
LARGEST_RECORD: Final = 16 * 2**20
#: Most bytes that packed recordings may take in memory. 12 drives of 1024x768 unpack to 1.6 GB, and our own recordings
#: are not packed at all: their images stay on the disk.
MOST_UNPACKED: Final = 4 * 2**30
#: What a file may unpack to, times its own size: as much as LZ4 can pack at all. Messages of a robot that stands reach
#: 18.
_MOST_RATIO: Final = 256
#: Bytes that a packed record takes at least. A message has another time and number than the last one: with the
#: strongest compression of Zstandard those of a robot that stands, with an exact clock, take 8.8.
_LEAST_RECORD: Final = 4
#: What is read; the index and all else is passed over.
_KINDS: Final[dict[int, type[Schema | Channel | Metadata | DataEnd]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata, Opcode.DATA_END: DataEnd,
}  # fmt: skip
_IN_CHUNKS: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
#: Of every record: what it is, and how many bytes follow.
HEAD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")

#: What is raised where there is no record.
UNREADABLE: Final = (McapError, ValueError, struct.error)


class MemoryLimitError(McapError):
    """What recordings unpack to takes too much memory; the text says so in one line."""


class Allowance:
    """How much memory may still be taken for what is read.

    A few bytes can be packed that fill any memory, and one image keeps all of its chunk: what is unpacked counts.
    """

    def __init__(self, size: int = MOST_UNPACKED) -> None:
        self.left = size
        self._size = size

    def take(self, size: int) -> None:
        """Take memory.

        Raises
        ------
        MemoryLimitError
            When it is too much.
        """
        if size > self.left:
            raise MemoryLimitError(f"takes more than {self._size / 2**30:.3g} GiB of memory, with what was read before")
        self.left -= size


class Fair:
    """What a file of some size may still unpack to: all that is honest fits, and nothing that takes for ever."""

    def __init__(self, size: int, allowance: Allowance) -> None:
        self._bytes = _MOST_RATIO * size
        self._records = size // _LEAST_RECORD
        self._allowance = allowance

    def unpack(self, chunk: Chunk) -> memoryview:
        """Unpack a chunk, never more of it than it announces.

        Raises
        ------
        MemoryLimitError
            When that is too much.
        McapError
            When it is damaged.
        """
        size = chunk.uncompressed_size
        if size > LARGEST_CHUNK:
            raise McapError(f"a chunk of {size} bytes, at most {LARGEST_CHUNK} are read")
        self._bytes -= size
        if self._bytes < 0:
            raise MemoryLimitError(f"unpacks to more than {_MOST_RATIO} times its size")
        self._allowance.take(size)
        data = _unpacked(chunk, size)
        if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise McapError("a chunk cannot be unpacked: its content is not what it says")
        return memoryview(data)

    def count(self, opcode: int) -> None:
        """Count a record in a chunk that was unpacked.

        Raises
        ------
        McapError
            When none of its kind may be in chunks, or there are too many.
        """
        if opcode not in _IN_CHUNKS:
            raise McapError(f"a record of kind {opcode} in a chunk")
        self._records -= 1
        if self._records < 0:
            raise McapError(f"a record for less than {_LEAST_RECORD} bytes of the file")


def mapped(path: Path) -> memoryview:
    """Return a file's bytes without reading them; parts of it are read where they are looked at.

    Raises
    ------
    OSError
        When the file cannot be opened, or is no regular file.
    """
    descriptor = open_regular(path)
    try:
        empty = os.fstat(descriptor).st_size == 0
        return memoryview(b"" if empty else mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))
    finally:
        os.close(descriptor)


def records(data: memoryview, allowance: Allowance | None = None) -> Iterator[McapRecord]:
    """Yield the whole records of the data section that hold something, those inside chunks in place of their chunk.

    Parameters
    ----------
    data
        A file's bytes, or those that a killed recorder left of it.
    allowance
        For what is unpacked; one of its own if not given.

    Raises
    ------
    MemoryLimitError
        When it unpacks to too much.
    McapError, ValueError, struct.error
        When the file is damaged otherwise.
    """
    if not MAGIC.startswith(bytes(data[: len(MAGIC)])):
        raise McapError("does not begin as an MCAP file")
    yield from walk(data, len(MAGIC), Fair(len(data), allowance or Allowance()))


def walk(data: memoryview, at: int, fair: Fair, *, unpacked: bool = False) -> Iterator[McapRecord]:
    """Yield the whole records from a place on, those inside chunks in place of their chunk; raises as `records`."""
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        begin, end = at + HEAD.size, at + HEAD.size + length
        if unpacked:
            fair.count(opcode)
        if opcode == Opcode.CHUNK and (inside := inside_of(data, at)) is not None:
            at = inside
            continue
        if end > len(data):
            return
        record = record_of(opcode, data[begin:end])
        if isinstance(record, DataEnd):
            return
        if isinstance(record, Chunk):
            yield from walk(fair.unpack(record), 0, fair, unpacked=True)
        elif record is not None:
            yield record
        at = end


def inside_of(data: memoryview, at: int) -> int | None:
    """Return where the records of the chunk begin that stands here; None where they are packed, or its head is cut.

    Records of a chunk that is not packed are read like those of a file without chunks: as far as they are there.

    Raises
    ------
    McapError
        When its head is damaged.
    """
    if at + CHUNK_HEAD.size > len(data):
        return None
    _, length, _, _, _, _, packed, size = CHUNK_HEAD.unpack_from(data, at)
    if packed:
        return None
    if length != CHUNK_HEAD.size - HEAD.size + size:
        raise McapError("a chunk of another size than its records")
    return at + CHUNK_HEAD.size


def record_of(opcode: int, body: memoryview) -> McapRecord | None:
    """Return a record, or None where it holds nothing that is read.

    Raises
    ------
    McapError, ValueError, struct.error
        When it is damaged.
    """
    if opcode == Opcode.MESSAGE:
        channel, tick, time, sent = _MESSAGE.unpack_from(body)
        data = cast("bytes", body[_MESSAGE.size :])
        return Message(channel_id=channel, sequence=tick, log_time=time, publish_time=sent, data=data)
    if opcode == Opcode.CHUNK:
        return cast("Chunk", Chunk.read(stream_of(body)))
    if opcode == 0:
        raise McapError("a record of no kind")
    if opcode not in _KINDS:
        return None
    if len(body) > LARGEST_RECORD:
        raise McapError(f"a record of {len(body)} bytes, at most {LARGEST_RECORD} are read")
    return cast("McapRecord", _KINDS[opcode].read(stream_of(body)))


def stream_of(data: bytes | memoryview) -> ReadDataStream:
    """Return what the ``mcap`` package reads a record from."""
    # It asks its input for no more than to read.
    return ReadDataStream(cast("Any", _Slices(memoryview(data))))


class _Slices:
    """What the ``mcap`` package reads from.

    It gives slices of a mapping, so that images are not read before they are wanted, and never less than was asked for:
    the package takes a message for whole of which a file has the beginning.
    """

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._position = 0

    def read(self, length: int) -> memoryview:
        begin, end = self._position, self._position + length
        if not begin <= end <= len(self._data):
            raise EndOfFile
        self._position = end
        return self._data[begin:end]


def _unpacked(chunk: Chunk, size: int) -> bytes:
    try:
        match chunk.compression:
            case "zstd":
                return ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
            case "lz4":
                return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
            case other:
                raise McapError(f"a chunk has the unknown compression {printable(other)}")
    except (ZstdError, RuntimeError, MemoryError) as error:
        # What the two decompressors raise is no business of the caller's.
        raise McapError(f"a chunk cannot be unpacked: {error}") from None
