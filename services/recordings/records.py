"""Records of an MCAP file that can be truncated, damaged or hostile.

The reader of the ``mcap`` package limits neither the unpacked size of chunks nor their number of
records, and it reads every image. So it only decodes single records.
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
# Start of every record: its opcode, and the number of following bytes.
HEAD: Final = struct.Struct("<BQ")
UNREADABLE: Final = (McapError, ValueError, struct.error)  # Raised for malformed records.
#: Largest unpacked chunk, bytes. Other programs write chunks of a few megabytes, or of one message;
#: the largest message is an image of 17 MB.
LARGEST_CHUNK: Final = 64 * 2**20
#: Largest decoded record, bytes; decoding takes 15 times as much memory. The largest of our records
#: is the list of gaps: 12 MB if every other frame of a day is missing.
_LARGEST_RECORD: Final = 16 * 2**20
#: Maximum memory of packed recordings, bytes. 12 drives of 1024x768 unpack to 1.6 GB; our own
#: recordings are not packed, and their images stay on the disk.
MOST_UNPACKED: Final = 4 * 2**30
_MOST_RATIO: Final = 256  # Largest ratio of unpacked to packed size, the limit of LZ4.
#: Minimum size of a packed record, bytes. Messages differ in time and number: messages of a
#: standing robot with an exact clock take 8.8 bytes with the strongest compression of Zstandard.
_LEAST_RECORD: Final = 4
#: Bytes of a mapped file in memory at once, and bytes that the system maps around each read.
_RESIDENT = 16 * 2**20
_AROUND = 2**16
#: Records that are decoded; the index and others are skipped.
_KINDS: Final[dict[int, type[Schema | Channel | Metadata]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata,
}  # fmt: skip
_IN_CHUNKS: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_MESSAGE: Final = struct.Struct("<HIQQ")


class MemoryLimitError(McapError):
    """Raised when unpacked recordings take too much memory; the text is one line."""


class Allowance:
    """Remaining memory for reading: an image keeps its whole unpacked chunk."""

    def __init__(self, size: int = MOST_UNPACKED) -> None:
        self.left = size
        self._size = size

    def take(self, size: int) -> None:
        """Take memory; raise MemoryLimitError if it exceeds the rest."""
        if size > self.left:
            raise MemoryLimitError(
                f"too large: more than {self._size / 2**30:.3g} GiB of memory, including "
                "earlier recordings"
            )
        self.left -= size


class Bounds:
    """Remaining bytes and records that one file can unpack to."""

    def __init__(self, size: int, allowance: Allowance | None = None) -> None:
        self._bytes = _MOST_RATIO * size
        self._records = size // _LEAST_RECORD
        self._allowance = allowance or Allowance()

    def unpack(self, chunk: Chunk) -> bytes:
        """Unpack a chunk up to its announced size; raise McapError if it is too large or damaged."""
        size = chunk.uncompressed_size
        if size > LARGEST_CHUNK:
            raise McapError(f"chunk too large ({size} bytes > maximum {LARGEST_CHUNK})")
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
                    raise McapError(f"unsupported compression {printable(other)} of a chunk")
        except (ZstdError, RuntimeError, MemoryError) as error:
            raise McapError(f"chunk cannot be unpacked: {error}") from None

    def count(self) -> None:
        """Count a record of an unpacked chunk; raise McapError if there are too many."""
        self._records -= 1
        if self._records < 0:
            raise McapError(
                f"too many records: one for less than {_LEAST_RECORD} bytes of the file"
            )


class _Mapped(mmap.mmap):
    """A mapped file, and the bytes read since its pages were last released."""

    touched = 0


def copied(payload: memoryview) -> bytes:
    """Copy recorded bytes, and release the pages of the file at intervals."""
    data = bytes(payload)
    _let_go(payload, len(data) + _AROUND)
    return data


def _let_go(data: memoryview, touched: int) -> None:
    """Release the pages of a mapped file once many bytes were read."""
    file = data.obj
    if isinstance(file, _Mapped):
        file.touched += touched
        if file.touched > _RESIDENT:
            file.touched = 0
            file.madvise(mmap.MADV_DONTNEED)


def mapped(path: Path) -> memoryview:
    """Map a file into memory; raise OSError if it is not a regular file."""
    descriptor = open_regular(path)
    try:
        empty = os.fstat(descriptor).st_size == 0
        return memoryview(b"" if empty else _Mapped(descriptor, 0, access=mmap.ACCESS_READ))
    finally:
        os.close(descriptor)


def records(data: memoryview, allowance: Allowance | None = None) -> Iterator[McapRecord]:
    """Yield the complete records, with those of chunks in place; raise ``UNREADABLE`` at damage."""
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
    """Opcode and bounds of a record, which can end after the end of the file."""

    opcode: int
    begin: int
    end: int


def heads(data: memoryview, at: int) -> Iterator[Head]:
    """Yield the heads of the records from a position on."""
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        head = Head(opcode, at + HEAD.size, at + HEAD.size + length)
        yield head
        at = head.end


def inside(chunk: Chunk, bounds: Bounds, *, checked: bool = False) -> Iterator[McapRecord]:
    """Yield the complete records in a chunk; verify the checksum if packed or ``checked``."""
    content = memoryview(bounds.unpack(chunk) if chunk.compression else chunk.data)
    checked |= bool(chunk.compression)
    if len(content) != chunk.uncompressed_size or (
        checked and chunk.uncompressed_crc not in (0, zlib.crc32(content))
    ):
        raise McapError("wrong checksum of a chunk")
    for opcode, begin, end in heads(content, 0):
        if opcode not in _IN_CHUNKS:
            raise McapError(f"a record of kind {opcode} in a chunk")
        if chunk.compression:
            bounds.count()
        if end <= len(content):
            yield cast("McapRecord", record_of(opcode, content[begin:end]))


def chunk_of(body: memoryview) -> Chunk:
    """Return a chunk by its head; raise errors as `records` does."""
    return cast("Chunk", Chunk.read(_stream_of(body)))


def record_of(opcode: int, body: memoryview) -> McapRecord | None:
    """Return a record outside chunks, or None for an ignored kind; raise errors as `records` does."""
    if opcode == Opcode.MESSAGE:
        channel, tick, time, sent = _MESSAGE.unpack_from(body)
        data = cast("bytes", body[_MESSAGE.size :])
        return Message(
            channel_id=channel, sequence=tick, log_time=time, publish_time=sent, data=data
        )
    if opcode == 0:
        raise McapError("record of unknown kind")
    if opcode not in _KINDS:
        return None
    if len(body) > _LARGEST_RECORD:
        raise McapError(f"record too large ({len(body)} bytes > maximum {_LARGEST_RECORD})")
    return cast("McapRecord", _KINDS[opcode].read(_stream_of(body)))


def _stream_of(data: memoryview) -> ReadDataStream:
    """Return a stream for the ``mcap`` package, which only reads from it."""
    return ReadDataStream(cast("Any", _Slices(data)))


class _Slices:
    """Returns slices of a mapping without reading them; EOF is damage."""

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
