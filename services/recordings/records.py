"""The records of an MCAP file, one after the other, as far as they are whole."""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Message, Metadata, Schema, Statistics
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


_KNOWN: Final = frozenset(int(opcode) for opcode in Opcode)
#: What of a summary is read.
_SUMMARIZED: Final[dict[int, type[Schema | Channel | Statistics]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.STATISTICS: Statistics,
}  # fmt: skip
#: Of every record: what it is, and how many bytes follow.
_HEAD: Final = struct.Struct("<BQ")
#: What follows the summary: the footer, and the magic.
_FOOTER: Final = _HEAD.size + 20
#: And what comes before it: the end of the data, with its checksum.
_DATA_END: Final = _HEAD.size + 4


#: What is raised where there is no record.
_UNREADABLE: Final = (McapError, ValueError, struct.error)


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
    allowance = allowance or Allowance()
    for record in _records(data):
        if not isinstance(record, Chunk):
            yield record
        elif record.compression:
            yield from _records(memoryview(_unpacked(record, allowance)), inside=True)
        else:
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


def surveyed(data: memoryview, tell: Callable[[str], None], allowance: Allowance | None = None) -> Iterator[McapRecord]:
    """Yield all that is whole in the data section, also behind what is damaged, and tell what is damaged.

    It takes the whole file to be read, images too. After a power failure zeros may stand in place of what was written.
    A record whose length is damaged leads astray. Chunks tell by their checksum that they are whole: the next one is
    looked for behind the last that was. What has no chunks has no checksums either.

    Parameters
    ----------
    data, allowance
        As for `records`.
    tell
        Called with each finding, a line.

    Raises
    ------
    MemoryLimitError
        When it unpacks to too much.
    """
    allowance = allowance or Allowance()
    summary = summary_of(data)
    data_end = len(data) if summary is None else summary.data_end
    at = sure = len(MAGIC)
    if data[:at] != MAGIC:
        tell("does not begin as an MCAP file")
    # The summary repeats schemas and channels: nothing that leads astray may lead there.
    data = data[: data_end + _DATA_END]
    while at < len(data):
        try:
            end, record = _record_at(data, at)
            inside = _whole(record, allowance) if isinstance(record, Chunk) else [record]
        except MemoryLimitError:
            raise
        except _UNREADABLE as error:
            found = _next_chunk(data, sure + 1, data_end)
            # What is cut off at its end, as by a kill, is told of as not sealed.
            if found < len(data) or not isinstance(error, EndOfFile):
                tell(f"damaged at byte {at}: what stands from byte {sure} to {found} is lost")
            if found <= sure:
                return
            at = sure = found
            continue
        if isinstance(record, DataEnd):
            if record.data_section_crc not in (0, zlib.crc32(data[:at])):
                tell("the checksum of its data is wrong")
            return
        yield from (one for one in inside if one is not None)
        at, sure = end, end if isinstance(record, Chunk | Message) else sure


def _record_at(data: memoryview, at: int) -> tuple[int, McapRecord | None]:
    """Return where a record ends, and the record if it holds something.

    Raises
    ------
    McapError, ValueError, struct.error
        When there is none.
    """
    if at + _HEAD.size > len(data):
        raise EndOfFile
    opcode, length = _HEAD.unpack_from(data, at)
    begin = at + _HEAD.size
    if begin + length > len(data):
        raise EndOfFile
    if opcode not in _KNOWN:
        raise McapError("no record")
    if opcode in _KINDS and length > _LARGEST_RECORD:
        raise McapError("too large a record")
    body = _stream(data[begin : begin + length])
    if opcode == Opcode.MESSAGE:
        return begin + length, Message.read(body, length)
    kind = Chunk if opcode == Opcode.CHUNK else _KINDS.get(opcode)
    return begin + length, None if kind is None else kind.read(body)


def _whole(chunk: Chunk, allowance: Allowance) -> list[McapRecord]:
    """Return the records of a chunk, whose checksum must be right."""
    if chunk.compression:
        content = memoryview(_unpacked(chunk, allowance))
    else:
        content = memoryview(chunk.data)
        if chunk.uncompressed_size != len(content) or chunk.uncompressed_crc not in (0, zlib.crc32(content)):
            raise McapError("its checksum is wrong")
    return list(_records(content, inside=True))


def _next_chunk(data: memoryview, at: int, end: int) -> int:
    """Return where the next chunk begins whose checksum is right, or `end`."""
    source = cast("mmap.mmap | bytes", data.obj)
    while (at := source.find(bytes([Opcode.CHUNK]), at, end)) >= 0:
        try:
            _, chunk = _record_at(data, at)
            if isinstance(chunk, Chunk) and chunk.uncompressed_crc:
                _whole(chunk, Allowance(_LARGEST_CHUNK))
                return at
        except _UNREADABLE:
            pass
        at += 1
    return end


@dataclass(frozen=True)
class Summary:
    """What stands at the end of a sealed recording.

    Attributes
    ----------
    data_end
        Where the record is that ends the data section.
    records
        Schemas and channels once more.
    messages
        How many there are; None if it does not say.
    """

    data_end: int
    records: tuple[McapRecord, ...]
    messages: int | None


def summary_of(data: memoryview) -> Summary | None:
    """Return what stands at the end of a sealed recording; None where it is not sealed, or its end is damaged."""
    end = len(data) - len(MAGIC) - _FOOTER
    if end < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return None
    footer = Footer.read(_stream(data[end + _HEAD.size : -len(MAGIC)]))
    begin = footer.summary_start or end
    if _HEAD.unpack_from(data, end) != (Opcode.FOOTER, 20) or not len(MAGIC) + _DATA_END <= begin <= end:
        return None
    # The checksum is of everything before itself.
    if footer.summary_crc not in (0, zlib.crc32(data[begin : len(data) - len(MAGIC) - 4])):
        return None
    try:
        found = list(_summary(data[begin:end]))
    except _UNREADABLE:
        return None
    counts = [one.message_count for one in found if isinstance(one, Statistics)]
    kept = tuple(one for one in found if isinstance(one, Schema | Channel))
    return Summary(begin - _DATA_END, kept, counts[0] if counts else None)


def _summary(data: memoryview) -> Iterator[McapRecord]:
    stream = _stream(data)
    try:
        while True:
            opcode, length = stream.read1(), stream.read8()
            body = _stream(stream.read(length))
            if opcode in _SUMMARIZED and length <= _LARGEST_RECORD:
                yield _SUMMARIZED[opcode].read(body)
    except EndOfFile:
        return
