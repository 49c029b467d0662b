"""All complete records of an MCAP file, also after damage, and the summary at its end."""

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple, cast

from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message

from services.recordings import records
from services.recordings.records import (
    MAGIC,
    UNREADABLE,
    Allowance,
    Bounds,
    Head,
    MemoryLimitError,
    heads,
)

_KNOWN: Final = frozenset(map(int, Opcode))
#: Before the magic at the end: position of the summary, of its index, and its checksum.
_FOOTER: Final = struct.Struct("<BQQQI")
#: Before the summary: the end of the data, with its checksum.
_DATA_END: Final = struct.Struct("<BQI")
_COUNT: Final = struct.Struct("<Q")  # First field of the statistics: the number of messages.
# Maximum number of bytes that a search for chunks checks, as a multiple of the file's size.
_CHECKED: Final = 4


class Summary(NamedTuple):
    """The summary of a sealed recording."""

    data_end: int  # Position of the record that ends the data section.
    records: tuple[McapRecord, ...] = ()  # Schemas and channels, repeated.
    messages: int | None = None  # Number of messages; None if unknown.


def summary_of(data: memoryview) -> Summary | None:
    """Return the summary of a recording; None if it is unsealed, or its end is damaged."""
    end = len(data) - len(MAGIC) - _FOOTER.size
    if end < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return None
    opcode, length, begin, _, checksum = _FOOTER.unpack_from(data, end)
    begin = begin or end
    if (opcode, length) != (Opcode.FOOTER, 20) or not len(MAGIC) + _DATA_END.size <= begin <= end:
        return None
    # The checksum covers everything before itself.
    if checksum not in (0, zlib.crc32(data[begin : len(data) - len(MAGIC) - 4])):
        return None
    kept: list[McapRecord] = []
    messages = None
    try:
        for kind, at, behind in heads(data[:end], begin):
            if kind in (Opcode.SCHEMA, Opcode.CHANNEL):
                kept.append(cast("McapRecord", records.record_of(kind, data[at:behind])))
            elif kind == Opcode.STATISTICS:
                (messages,) = _COUNT.unpack_from(data, at)
    except UNREADABLE:
        return None
    return Summary(begin - _DATA_END.size, tuple(kept), messages)


def surveyed(data: memoryview, tell: Callable[[str], None]) -> Iterator[McapRecord]:
    """Yield the schemas and channels of the summary, then all complete records of the data section.

    After a damaged length, reading continues at the next chunk with a correct checksum. ``tell``
    receives each finding. Raises MemoryLimitError if the file unpacks to too much memory.
    """
    known = summary_of(data) or Summary(len(data))
    count = orphans = 0
    yield from known.records
    channels = {one.id for one in known.records if isinstance(one, Channel)}
    # The summary repeats schemas and channels: no damaged length must lead there.
    section = data[: known.data_end + _DATA_END.size]
    for record in _Survey(section, known.data_end, tell).records():
        if isinstance(record, Channel):
            channels.add(record.id)
        elif isinstance(record, Message):
            count += 1
            orphans += record.channel_id not in channels
        yield record
    if orphans:
        tell(f"{orphans} messages of a lost channel")
    if known.messages not in (None, count):
        tell(f"index announces {known.messages} messages, but there are {count}")


class _Survey:
    """Reads complete records; `sure` is the end of the last record whose position is certain."""

    def __init__(self, data: memoryview, data_end: int, tell: Callable[[str], None]) -> None:
        self._data = data
        self._data_end = data_end
        self._tell = tell
        self._bounds = Bounds(len(data))
        self._search = ChunkSearch(data)
        self._sure = len(MAGIC)

    def records(self) -> Iterator[McapRecord]:
        at = self._sure
        while at < len(self._data):
            try:
                head = _head(self._data, at)
                found = self._records_of(head)
            except MemoryLimitError:
                raise
            except UNREADABLE as error:
                at = self._skip_damage(at, cut_off=isinstance(error, EndOfFile))
            else:
                yield from found
                at = self._behind(head)

    def _records_of(self, head: Head) -> list[McapRecord]:
        """Return the records in a chunk, or the record itself if it has content."""
        body = self._data[head.begin : head.end]
        if head.opcode == Opcode.CHUNK:
            return list(records.inside(records.chunk_of(body), self._bounds, checked=True))
        record = records.record_of(head.opcode, body)
        return [] if record is None else [record]

    def _skip_damage(self, at: int, *, cut_off: bool) -> int:
        """Return the position of the next valid chunk, if any."""
        following = self._search.next(self._sure + 1, self._data_end)
        if following < len(self._data) or not cut_off:
            lost = f"bytes {self._sure} to {following} are lost"
            self._tell(f"damaged at byte {at}: {lost}")
        self._sure = following if following > self._sure else len(self._data)
        return self._sure

    def _behind(self, head: Head) -> int:
        """Return the position of the next record, and verify the data checksum at the end."""
        if head.opcode == Opcode.DATA_END:
            checksum = int.from_bytes(self._data[head.begin : head.begin + 4], "little")
            before = self._data[: head.begin - records.HEAD.size]
            if checksum not in (0, zlib.crc32(before)):
                self._tell("wrong checksum of the data")
            return len(self._data)
        if head.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            self._sure = head.end
        return head.end


def _head(data: memoryview, at: int) -> Head:
    """Return the head of the record at a position; raise EndOfFile if truncated, McapError if invalid."""
    head = next(heads(data, at), None)
    if head is None or head.end > len(data):
        raise EndOfFile
    if head.opcode not in _KNOWN:
        raise McapError("no record")
    return head


class ChunkSearch:
    """Finds the chunks after damage by their checksums.

    Any byte can look like the head of a large chunk. The number of checked bytes is limited, so
    that no file can cause an endless search.
    """

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._left = _CHECKED * len(data)

    def next(self, at: int, end: int) -> int:
        """Return the position of the next chunk with a correct checksum, or `end`."""
        source = cast("mmap.mmap | bytes", self._data.obj)
        while self._left > 0 and (at := source.find(bytes([Opcode.CHUNK]), at, end)) >= 0:
            try:
                _, begin, behind = _head(self._data, at)
                chunk = records.chunk_of(self._data[begin:behind])
                if chunk.uncompressed_crc:
                    self._left -= behind - at
                    list(
                        records.inside(
                            chunk,
                            Bounds(len(self._data), Allowance(records.LARGEST_CHUNK)),
                            checked=True,
                        )
                    )
                    return at
            except UNREADABLE:
                pass
            at += 1
        return end
