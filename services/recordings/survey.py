"""All that is whole in an MCAP file, also behind what is damaged; and what stands at its end."""

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
#: What stands before the magic at the end: where the summary begins, where its parts are listed, its checksum.
_FOOTER: Final = struct.Struct("<BQQQI")
_DATA_END: Final = struct.Struct(
    "<BQI"
)  # And before the summary: the end of the data, with its checksum.
_COUNT: Final = struct.Struct("<Q")  # The first of the statistics is how many messages there are.
_CHECKED: Final = 4  # How many times the bytes of a file a search for chunks may check.


class Summary(NamedTuple):
    """What stands at the end of a sealed recording."""

    data_end: int  # Where the record is that ends the data section.
    records: tuple[McapRecord, ...] = ()  # Schemas and channels once more.
    messages: int | None = None  # How many there are; None if it does not say.


def summary_of(data: memoryview) -> Summary | None:
    """Return what stands at the end of a sealed recording; None where it is not sealed, or its end is damaged."""
    end = len(data) - len(MAGIC) - _FOOTER.size
    if end < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return None
    opcode, length, begin, _, checksum = _FOOTER.unpack_from(data, end)
    begin = begin or end
    if (opcode, length) != (Opcode.FOOTER, 20) or not len(MAGIC) + _DATA_END.size <= begin <= end:
        return None
    # The checksum is of everything before itself.
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
    """Yield the schemas and channels of the summary, then all that is whole in the data section, also behind damage.

    A record whose length is damaged leads astray: the next chunk whose checksum is right is looked for. ``tell`` is
    called with each finding. MemoryLimitError where it unpacks to too much.
    """
    known = summary_of(data) or Summary(len(data))
    count = orphans = 0
    yield from known.records
    channels = {one.id for one in known.records if isinstance(one, Channel)}
    # The summary repeats schemas and channels: nothing that leads astray may lead there.
    for record in _whole(data[: known.data_end + _DATA_END.size], known.data_end, tell):
        if isinstance(record, Channel):
            channels.add(record.id)
        elif isinstance(record, Message):
            count += 1
            orphans += record.channel_id not in channels
        yield record
    if orphans:
        tell(f"{orphans} messages are of a channel that is lost")
    if known.messages not in (None, count):
        tell(f"its index tells of {known.messages} messages, and there are {count}")


def _whole(data: memoryview, data_end: int, tell: Callable[[str], None]) -> Iterator[McapRecord]:
    bounds = Bounds(len(data))
    search = ChunkSearch(data)
    at = sure = len(MAGIC)
    while at < len(data):
        try:
            opcode, begin, end = _head(data, at)
            body = data[begin:end]
            is_chunk = opcode == Opcode.CHUNK
            found = (
                [*records.inside(records.chunk_of(body), bounds, checked=True)]
                if is_chunk
                else [records.record_of(opcode, body)]
            )
        except MemoryLimitError:
            raise
        except UNREADABLE as error:
            following = search.next(sure + 1, data_end)
            # What is cut off at its end, as by a kill, is told of as not sealed.
            if following < len(data) or not isinstance(error, EndOfFile):
                tell(f"damaged at byte {at}: what stands from byte {sure} to {following} is lost")
            if following <= sure:
                return
            at = sure = following
            continue
        if opcode == Opcode.DATA_END:
            if int.from_bytes(body[:4], "little") not in (0, zlib.crc32(data[:at])):
                tell("the checksum of its data is wrong")
            return
        yield from (one for one in found if one is not None)
        at = end
        sure = end if opcode in (Opcode.CHUNK, Opcode.MESSAGE) else sure


def _head(data: memoryview, at: int) -> Head:
    """Return the head of the record that stands here; EndOfFile where it is cut off, McapError where there is none."""
    head = next(heads(data, at), None)
    if head is None or head.end > len(data):
        raise EndOfFile
    if head.opcode not in _KNOWN:
        raise McapError("no record")
    return head


class ChunkSearch:
    """Finds the chunks behind damage, by their checksums.

    Any byte may look like the head of a large chunk. So no more bytes are checked than a few times those that are
    there: what damage leaves is found, and a file made to be searched for ever is not.
    """

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._left = _CHECKED * len(data)

    def next(self, at: int, end: int) -> int:
        """Return where the next chunk begins whose checksum is right, or `end`."""
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
