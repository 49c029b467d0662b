"""What a recorder left that was killed, or whose disk was full, is sealed in its place, without an index."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Message, Metadata

from schemas.topics import EPISODE, topic_of
from services.kit.errors import JobError
from services.recordings.records import (
    MAGIC,
    UNREADABLE,
    Bounds,
    chunk_of,
    heads,
    inside,
    mapped,
    record_of,
)
from services.recordings.sink import Sink, claim, finished, publish
from services.recordings.survey import ChunkSearch
from services.recordings.writer import GAPS_METADATA

_UNSURE: Final = (
    16 * 2**20
)  # May not have reached the disk at a power failure: checksums are checked there.


class LeftoverError(JobError):
    """What was left cannot be sealed, and stays as it is."""


class Sealed(NamedTuple):
    """What became of a leftover."""

    path: Path | None  # The recording; None where no message was in it, and it is removed.
    episode: str  # Its id; empty where it does not tell.
    ended: bool  # Whether the end of the episode is in it.


def seal_leftover(partial: Path) -> Sealed:
    """Seal what a dead recorder left; what was cut off at its end is lost.

    Raises LeftoverError when it is not the recording of an episode, or damaged; OSError when it cannot be opened, its
    recorder lives (BlockingIOError), or there is no room for its end.
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
        end: Any = RecordBuilder()  # Without an index every reader reads it from its beginning.
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
    """Takes record after record: where all that is whole ends, and what it tells of its episode."""

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
            raise LeftoverError("it is not the recording of an episode")
        # What is not whole may be a chunk at the end, or zeros; what is damaged before hides what is whole.
        head = next(heads(data, self.size), None)
        is_last = head is None or head.end > len(data) or head.opcode in (0, Opcode.CHUNK)
        if not whole and not (
            is_last and ChunkSearch(data).next(self.size + 1, len(data)) == len(data)
        ):
            raise LeftoverError(f"it is damaged at byte {self.size}; see smal recording repair")

    def _take_all(self) -> bool:
        """Return whether the end of the records was reached."""
        while (head := next(heads(self._data, self.size), None)) is not None and head.end <= len(
            self._data
        ):
            body = self._data[head.begin : head.end]
            match head.opcode:
                case Opcode.HEADER | Opcode.MESSAGE_INDEX:
                    pass
                case Opcode.METADATA:
                    record = cast("Metadata", record_of(Opcode.METADATA, body))
                    self.episode = record.metadata.get("episode", self.episode)
                    # It is the first thing that is written when an episode is over.
                    self.ended |= record.name == GAPS_METADATA
                case Opcode.CHUNK:
                    chunk = chunk_of(body)
                    if chunk.compression:
                        raise McapError("a chunk that is none of a recorder's")
                    for one in inside(
                        chunk, Bounds(len(self._data)), checked=head.end > len(self._data) - _UNSURE
                    ):
                        if isinstance(one, Channel) and topic_of(one.topic) is EPISODE:
                            self._events.add(one.id)
                        elif isinstance(one, Message) and one.channel_id in self._events:
                            self.ended |= b'"event":"ended"' in bytes(one.data)
                    self.chunks += 1
                case other:
                    return other == Opcode.DATA_END
            self.size = head.end
        return self.size == len(self._data)
