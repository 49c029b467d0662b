"""Sealing of a file without an index, left by a killed recorder or a full disk."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Metadata

from schemas.topics import EPISODE, topic_of
from services.kit.errors import JobError
from services.recordings.records import (
    MAGIC,
    UNREADABLE,
    Bounds,
    Head,
    chunk_of,
    heads,
    inside,
    mapped,
    record_of,
)
from services.recordings.sink import Sink, claim, finished, publish
from services.recordings.survey import ChunkSearch
from services.recordings.writer import GAPS_METADATA

#: Bytes at the end that a power failure can lose; their checksums are verified.
_UNSURE: Final = 16 * 2**20
_BEFORE_THE_END: Final = (Opcode.HEADER, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.CHUNK)


class LeftoverError(JobError):
    """Raised when a leftover cannot be sealed; the file stays unchanged."""


class Sealed(NamedTuple):
    """The result of sealing a leftover."""

    path: Path | None  # The recording; None if it contained no message and is deleted.
    episode: str  # Id of the episode; empty if unknown.
    ended: bool  # Whether it contains the end of the episode.


def seal_leftover(partial: Path) -> Sealed:
    """Seal the file of a killed recorder; a truncated last record is lost.

    Raises
    ------
    LeftoverError
        If the file is not the recording of an episode, or is damaged.
    BlockingIOError
        If its recorder is running.
    OSError
        If the file cannot be opened, or the disk is full.
    """
    descriptor = claim(partial)
    try:
        found = _Look(mapped(partial))
        if not found.chunks:
            partial.unlink()
        sink = Sink(descriptor, found.size)
    except BaseException:
        os.close(descriptor)
        raise
    try:
        if not found.chunks:
            return Sealed(None, found.episode, ended=False)
        end: Any = RecordBuilder()  # Without an index readers start at the beginning.
        DataEnd(0).write(end)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(end)
        sink.write(end.end() + MAGIC)
        sink.sync()
        path = finished(partial)
        publish(partial, path)
        return Sealed(path, found.episode, found.ended)
    finally:
        sink.close()


class _Look:
    """Reads the records of a leftover: size of the complete records, episode, and whether it ended."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._events: set[int] = set()
        self.chunks = 0
        self.size = len(MAGIC)
        self.episode = ""
        self.ended = False
        if MAGIC.startswith(bytes(data[: self.size + 1])):
            return
        whole = False
        with suppress(*UNREADABLE):
            whole = data[: self.size] == MAGIC and self._take_all()
        if not self.episode:
            raise LeftoverError("not the recording of an episode")
        # The last record can be truncated or zeros; damage before it hides complete records.
        head = next(heads(data, self.size), None)
        is_last = head is None or head.end > len(data) or head.opcode in (0, Opcode.CHUNK)
        if not whole and not (
            is_last and ChunkSearch(data).next(self.size + 1, len(data)) == len(data)
        ):
            raise LeftoverError(f"damaged at byte {self.size}; see smal recording repair")

    def _take_all(self) -> bool:
        """Read complete records; return whether the end of the records was reached."""
        for head in heads(self._data, self.size):
            if head.end > len(self._data):
                return False
            if not self._take(head):
                return head.opcode == Opcode.DATA_END
            self.size = head.end
        return self.size == len(self._data)

    def _take(self, head: Head) -> bool:
        """Read a record; return whether the recorder writes such records before the end."""
        body = self._data[head.begin : head.end]
        if head.opcode == Opcode.METADATA:
            record = cast("Metadata", record_of(Opcode.METADATA, body))
            self.episode = record.metadata.get("episode", self.episode)
            # The gaps are the first record written after an episode.
            self.ended |= record.name == GAPS_METADATA
        elif head.opcode == Opcode.CHUNK:
            is_sure = head.end <= len(self._data) - _UNSURE
            self._take_chunk(chunk_of(body), checked=not is_sure)
            self.chunks += 1
        return head.opcode in _BEFORE_THE_END

    def _take_chunk(self, chunk: Chunk, *, checked: bool) -> None:
        if chunk.compression:
            raise McapError("chunk from another program")
        for one in inside(chunk, Bounds(len(self._data)), checked=checked):
            if isinstance(one, Channel) and topic_of(one.topic) is EPISODE:
                self._events.add(one.id)
            elif isinstance(one, Message) and one.channel_id in self._events:
                self.ended |= b'"event":"ended"' in bytes(one.data)
