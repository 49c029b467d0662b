"""What is whole in an MCAP file, also behind what is damaged; and what stands at its end."""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, cast

from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, McapRecord, Message, Schema, Statistics

from services.recordings.records import (
    HEAD,
    KEPT_FREE,
    LARGEST_CHUNK,
    LARGEST_RECORD,
    MAGIC,
    UNREADABLE,
    Allowance,
    Fair,
    MemoryLimitError,
    inside_of,
    record_of,
    stream_of,
    walk,
)

_KNOWN: Final = frozenset([*map(int, Opcode), KEPT_FREE])
#: What of a summary is read.
_SUMMARIZED: Final[dict[int, type[Schema | Channel | Statistics]]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.STATISTICS: Statistics,
}  # fmt: skip
#: What follows the summary: the footer, and the magic.
_FOOTER: Final = HEAD.size + 20
#: And what comes before it: the end of the data, with its checksum.
_DATA_END: Final = HEAD.size + 4

#: How many times the bytes that are there a search for chunks may check.
_CHECKED: Final = 4


def surveyed(data: memoryview, tell: Callable[[str], None], allowance: Allowance | None = None) -> Iterator[McapRecord]:
    """Yield all that is whole in the data section, also behind what is damaged, and tell what is damaged.

    It takes the whole file to be read, images too. After a power failure zeros may stand in place of what was written.
    A record whose length is damaged leads astray. Chunks tell by their checksum that they are whole: the next one is
    looked for behind the last that was. What has no chunks, or is cut off in one, has no checksums either.

    Parameters
    ----------
    data, allowance
        As for `records.records`.
    tell
        Called with each finding, a line.

    Raises
    ------
    MemoryLimitError
        When it unpacks to too much.
    """
    fair = Fair(len(data), allowance or Allowance())
    summary = summary_of(data)
    data_end = len(data) if summary is None else summary.data_end
    at = sure = len(MAGIC)
    if data[:at] != MAGIC:
        tell("does not begin as an MCAP file")
    # The summary repeats schemas and channels: nothing that leads astray may lead there.
    data = data[: data_end + _DATA_END]
    search = ChunkSearch(data)
    while at < len(data):
        try:
            end, record = _record_at(data, at)
            inside = _whole(record, fair) if isinstance(record, Chunk) else [record]
        except MemoryLimitError:
            raise
        except UNREADABLE as error:
            cut = isinstance(error, EndOfFile)
            found = search.next(sure + 1, data_end)
            if cut and found >= data_end and (begin := _inside_of_cut(data, at)) is not None:
                at = sure = begin
                continue
            # What is cut off at its end, as by a kill, is told of as not sealed.
            if found < len(data) or not cut:
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
    if at + HEAD.size > len(data):
        raise EndOfFile
    opcode, length = HEAD.unpack_from(data, at)
    begin = at + HEAD.size
    if begin + length > len(data):
        raise EndOfFile
    if opcode not in _KNOWN:
        raise McapError("no record")
    return begin + length, record_of(opcode, data[begin : begin + length])


def _inside_of_cut(data: memoryview, at: int) -> int | None:
    """Return where the records of the chunk begin that is cut off; None where there is none, or it is packed."""
    try:
        return inside_of(data, at) if data[at] == Opcode.CHUNK else None
    except McapError:
        return None


def _whole(chunk: Chunk, fair: Fair) -> list[McapRecord]:
    """Return the records of a chunk, whose checksum must be right."""
    if chunk.compression:
        return list(walk(fair.unpack(chunk), 0, fair, unpacked=True))
    content = memoryview(chunk.data)
    if chunk.uncompressed_size != len(content) or chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise McapError("its checksum is wrong")
    return list(walk(content, 0, fair))


class ChunkSearch:
    """Finds the chunks behind damage, by their checksums.

    Any byte may look like the head of a large chunk. So no more bytes are checked than a few times those that are
    there: what damage leaves is found, and a file made to be searched for ever is not.
    """

    def __init__(self, data: memoryview) -> None:
        self._data, self._left = data, _CHECKED * len(data)

    def next(self, at: int, end: int) -> int:
        """Return where the next chunk begins whose checksum is right, or `end`."""
        source = cast("mmap.mmap | bytes", self._data.obj)
        while self._left > 0 and (at := source.find(bytes([Opcode.CHUNK]), at, end)) >= 0:
            try:
                behind, chunk = _record_at(self._data, at)
                if isinstance(chunk, Chunk) and chunk.uncompressed_crc:
                    self._left -= behind - at
                    _whole(chunk, Fair(len(self._data), Allowance(LARGEST_CHUNK)))
                    return at
            except UNREADABLE:
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
    footer = Footer.read(stream_of(data[end + HEAD.size : -len(MAGIC)]))
    begin = footer.summary_start or end
    if HEAD.unpack_from(data, end) != (Opcode.FOOTER, 20) or not len(MAGIC) + _DATA_END <= begin <= end:
        return None
    # The checksum is of everything before itself.
    if footer.summary_crc not in (0, zlib.crc32(data[begin : len(data) - len(MAGIC) - 4])):
        return None
    try:
        found = list(_summary(data[begin:end]))
    except UNREADABLE:
        return None
    counts = [one.message_count for one in found if isinstance(one, Statistics)]
    kept = tuple(one for one in found if isinstance(one, Schema | Channel))
    return Summary(begin - _DATA_END, kept, counts[0] if counts else None)


def _summary(data: memoryview) -> Iterator[McapRecord]:
    stream = stream_of(data)
    try:
        while True:
            opcode, length = stream.read1(), stream.read8()
            body = stream_of(stream.read(length))
            if opcode in _SUMMARIZED and length <= LARGEST_RECORD:
                yield _SUMMARIZED[opcode].read(body)
    except EndOfFile:
        return
