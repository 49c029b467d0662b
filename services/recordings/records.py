"""The records of an MCAP file, one after the other, as far as they are whole.

The readers of the ``mcap`` package give a truncated last message as if it were whole, and read every image although
learning wants none of them. An MCAP file is simple enough to walk: an opcode, a length, that many bytes.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Final, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable

#: First and last bytes of every MCAP file.
MAGIC: Final = MCAP0_MAGIC
_FRAME: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
#: A chunk: two times, size, checksum; length of the compression's name; with an empty name the length of the records.
_COMPRESSION: Final = slice(28, 32)
_UNCOMPRESSED_HEADER: Final = 40
#: Most bytes that a packed chunk may unpack to; other tools make chunks of a few megabytes.
_LARGEST_CHUNK: Final = 256 * 1024 * 1024


class Record(NamedTuple):
    """One whole record."""

    opcode: int
    offset: int
    """Where it begins in the file (in its chunk, for a record inside a chunk)."""
    body: memoryview

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + _FRAME.size + len(self.body)


class MessageHeader(NamedTuple):
    """What stands before a message's payload."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int


def view_of(descriptor: int) -> memoryview:
    """Return a file's bytes without reading them; parts of it are read where they are looked at.

    Raises
    ------
    ValueError
        When the file is empty.
    """
    return memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))


def records(data: memoryview, start: int = len(MAGIC)) -> Iterator[Record]:
    """Yield the whole records from ``start``; stop at the end of the data section or where the file is cut."""
    offset = start
    while offset + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, offset)
        end = offset + _FRAME.size + length
        # Opcode 0 is none: blocks of zeros are what a power failure leaves of bytes that were not yet on the disk.
        if opcode == 0 or end > len(data):
            return
        yield Record(opcode, offset, data[offset + _FRAME.size : end])
        if opcode == Opcode.DATA_END:
            return
        offset = end


def flat_records(data: memoryview) -> Iterator[Record]:
    """Yield the whole records, those inside chunks in place of their chunk."""
    for record in records(data):
        if record.opcode == Opcode.CHUNK:
            yield from records(chunk_content(record.body), start=0)
        else:
            yield record


def chunk_content(body: memoryview) -> memoryview:
    """Return the records in a chunk.

    Raises
    ------
    McapError
        When a compressed chunk cannot be unpacked.
    """
    if bytes(body[_COMPRESSION]) == b"\0\0\0\0":
        # Not compressed, as in our own files: nothing is read or copied before it is wanted.
        return body[_UNCOMPRESSED_HEADER:]
    try:
        chunk = Chunk.read(fields(body))
        data = _unpacked(chunk)
    except (ZstdError, RuntimeError, MemoryError, OverflowError) as error:
        # What the two decompressors raise, and a length beyond all memory, is no business of the caller's.
        raise McapError(f"a chunk cannot be unpacked: {error}") from None
    if len(data) != chunk.uncompressed_size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk cannot be unpacked: its content is not what it says")
    return memoryview(data)


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack a chunk, never more of it than it announces: a few bytes can be packed that fill any memory."""
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise McapError(f"a chunk of {size} bytes, at most {_LARGEST_CHUNK} are read")
    match chunk.compression:
        case "zstd":
            return ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
        case "lz4":
            return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
        case other:
            raise McapError(f"a chunk has the unknown compression {printable(other)}")


def fields(body: memoryview) -> ReadDataStream:
    """Return a record's body as what the ``read`` methods of ``mcap.records`` take."""
    return ReadDataStream(BytesIO(body))


def message_header(body: memoryview) -> MessageHeader:
    """Return the header of a message record."""
    return MessageHeader._make(_MESSAGE.unpack_from(body))


def message_payload(body: memoryview) -> memoryview:
    """Return the payload of a message record."""
    return body[_MESSAGE.size :]
