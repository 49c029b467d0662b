"""What a recorder left that was killed, or whose disk was full, is sealed where it stands: nothing is copied."""

from __future__ import annotations

import os
from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple, cast

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema

from schemas.topics import EPISODE, topic_of
from services.kit.errors import JobError
from services.recordings.chunks import Index
from services.recordings.records import MAGIC, UNREADABLE, Bounds, chunk_of, heads, inside, mapped, record_of
from services.recordings.sink import Sink, claim, finished, publish
from services.recordings.survey import ChunkSearch
from services.recordings.writer import GAPS_METADATA

#: So much at its end may not have reached the disk when the power failed: there chunks are checked by their checksums.
_UNSURE: Final = 16 * 2**20


class LeftoverError(JobError):
    """What was left cannot be sealed, and stays as it is."""


class Sealed(NamedTuple):
    """What became of a leftover."""

    path: Path | None
    """The recording; None where no message was in it, and it is removed."""
    episode: str
    """Its id; empty where it does not tell."""
    ended: bool
    """Whether the end of the episode is in it."""


def seal_leftover(partial: Path) -> Sealed:
    """Seal what a dead recorder left; what was cut off at its end is lost.

    Raises LeftoverError when it is not the recording of an episode, or damaged; OSError when it cannot be opened, its
    recorder lives (BlockingIOError), or there is no room for its end.
    """
    descriptor = claim(partial)
    try:
        found = _Look(mapped(partial))
        if not found.index.chunks:
            partial.unlink()
        sink = Sink(descriptor, found.size)
    except BaseException:
        os.close(descriptor)
        raise
    try:
        if not found.index.chunks:
            return Sealed(None, found.episode, ended=False)
        # The checksum of all of it would take to read all of it.
        sink.write(found.index.end(found.size, checksum=0))
        sink.sync()
        path = finished(partial)
        publish(partial, path)
        return Sealed(path, found.episode, found.ended)
    finally:
        sink.close()


class _Look:
    """Takes record after record: of all that is whole it has the index, and the size."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._events: set[int] = set()
        self.index = Index()
        self.size = len(MAGIC)
        self.episode = ""
        self.ended = False
        if MAGIC.startswith(bytes(data[: self.size + 1])):
            return
        try:
            whole = data[: self.size] == MAGIC and self._take_all()
        except UNREADABLE:
            whole = False
        if not self.episode:
            raise LeftoverError("it is not the recording of an episode")
        if not whole and not self._is_cut():
            raise LeftoverError(f"it is damaged at byte {self.size}; see smal recording repair")

    def _is_cut(self) -> bool:
        """Whether what is not whole is a chunk at the end, or zeros; what is damaged before hides what is whole."""
        head = next(heads(self._data, self.size), None)
        is_last = head is None or head.end > len(self._data) or head.opcode in (0, Opcode.CHUNK)
        return is_last and ChunkSearch(self._data).next(self.size + 1, len(self._data)) == len(self._data)

    def _take_all(self) -> bool:
        """Return whether the end of the records was reached."""
        while (head := next(heads(self._data, self.size), None)) is not None and head.end <= len(self._data):
            body = self._data[head.begin : head.end]
            match head.opcode:
                case Opcode.HEADER:
                    self.size = head.end
                case Opcode.METADATA:
                    record = cast("Metadata", record_of(Opcode.METADATA, body))
                    self.index.add_metadata(record.name, self.size, head.end - self.size)
                    self.size = head.end
                    self.episode = record.metadata.get("episode", self.episode)
                    # It is the first thing that is written when an episode is over.
                    self.ended |= record.name == GAPS_METADATA
                case Opcode.CHUNK:
                    self._take_chunk(chunk_of(body), head.end)
                case other:
                    return other == Opcode.DATA_END
        return self.size == len(self._data)

    def _take_chunk(self, chunk: Chunk, end: int) -> None:
        """Take a chunk and the indexes of its messages; raises McapError where these are not whole."""
        if chunk.compression:
            raise McapError("a chunk that is none of a recorder's")
        counts = self._counted_inside(chunk, checked=end > len(self._data) - _UNSURE)
        behind = self.index.indexes_end(end, counts)
        opcodes = [head.opcode for head in islice(heads(self._data[:behind], end), len(counts) + 1)]
        if behind > len(self._data) or opcodes != [Opcode.MESSAGE_INDEX] * len(counts):
            raise McapError("a chunk without its indexes")
        self.index.add_chunk(chunk, self.size, end - self.size, counts)
        self.size = behind

    def _counted_inside(self, chunk: Chunk, *, checked: bool) -> Counter[int]:
        """Take note of what is in a chunk; return its messages by channel, in the order in which they begin."""
        counts = Counter[int]()
        for record in inside(chunk, Bounds(len(self._data)), checked=checked):
            if isinstance(record, Schema):
                self.index.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.index.channels[record.id] = record
                if topic_of(record.topic) is EPISODE:
                    self._events.add(record.id)
            elif isinstance(record, Message):
                counts[record.channel_id] += 1
                told = record.channel_id in self._events
                self.ended |= told and b'"event":"ended"' in bytes(record.data)
        return counts
