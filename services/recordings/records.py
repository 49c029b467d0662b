"""The records of an MCAP file, one after the other, as far as they are whole."""

from __future__ import annotations

import mmap
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, cast

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import read_magic
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable
from smal.regular_file import open_regular

#: First and last bytes of every MCAP file.
MAGIC: Final = MCAP0_MAGIC
#: Most bytes that a packed chunk may unpack to. Other tools make chunks of a few megabytes, and at least of one
#: message; the largest is a raw image of 38 MB.
_LARGEST_CHUNK: Final = 64 * 2**20
#: Most bytes of a record that is taken apart, which takes 15 times as much memory. The largest is the list of what a
#: recording lacks: 12 MB, where every other frame of a day is missing.
_LARGEST_RECORD: Final = 16 * 2**20
#: Most bytes that packed recordings may take in memory. 12 drives of 1024x768 unpack to 1.6 GB, and our own recordings
#: are not packed at all: their images stay on the disk.
MOST_UNPACKED: Final = 4 * 2**30
#: What is read; the index and all else is passed over.
_KINDS: Final[dict[int, type[Schema | Channel | Metadata | DataEnd]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata, Opcode.DATA_END: DataEnd,
}  # fmt: skip


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


def records(data: memoryview, allowance: Allowance | None = None, *, checked: bool = False) -> Iterator[McapRecord]:
    """Yield the whole records of the data section that hold something, those inside chunks in place of their chunk.

    Parameters
    ----------
    data
        A file's bytes, or those that a killed recorder left of it.
    allowance
        For what is unpacked; one of its own if not given.
    checked
        Whether to leave out chunks whose checksum is wrong: after a power failure the last ones may have zeros in place
        of their end. It takes the whole file to be read, images too.

    Raises
    ------
    MemoryLimitError
        When it unpacks to too much.
    McapError, ValueError, struct.error
        When the file is damaged otherwise.
    """
    allowance = allowance or Allowance()
    for record in _records(data):
        if not isinstance(record, Chunk):
            yield record
        elif record.compression:
            yield from _records(memoryview(_unpacked(record, allowance)), inside=True)
        elif not checked or record.uncompressed_crc in (0, zlib.crc32(record.data)):
            yield from _records(memoryview(record.data), inside=True)


def _records(data: memoryview, *, inside: bool = False) -> Iterator[McapRecord]:
    stream = _stream(data)
    try:
        if not inside:
            read_magic(stream)
        while True:
            opcode, length = stream.read1(), stream.read8()
            body = _stream(stream.read(length))
            if opcode == Opcode.MESSAGE:
                yield Message.read(body, length)
            elif opcode == Opcode.CHUNK:
                yield Chunk.read(body)
            elif opcode in _KINDS:
                if length > _LARGEST_RECORD:
                    raise McapError(f"a record of {length} bytes, at most {_LARGEST_RECORD} are read")
                record = _KINDS[opcode].read(body)
                if isinstance(record, DataEnd):
                    return
                yield record
    except EndOfFile:
        return


def _stream(data: bytes | memoryview) -> ReadDataStream:
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


def _unpacked(chunk: Chunk, allowance: Allowance) -> bytes:
    """Unpack a chunk, never more of it than it announces."""
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise McapError(f"a chunk of {size} bytes, at most {_LARGEST_CHUNK} are read")
    allowance.take(size)
    try:
        match chunk.compression:
            case "zstd":
                data = ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
            case "lz4":
                data = bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
            case other:
                raise McapError(f"a chunk has the unknown compression {printable(other)}")
    except (ZstdError, RuntimeError, MemoryError) as error:
        # What the two decompressors raise is no business of the caller's.
        raise McapError(f"a chunk cannot be unpacked: {error}") from None
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk cannot be unpacked: its content is not what it says")
    return data
