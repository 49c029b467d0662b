"""What a recorder left that was killed, or whose disk was full, is sealed where it stands: nothing is copied."""

from __future__ import annotations

import mmap
import os
import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, McapRecord, Message, Metadata, MetadataIndex, Schema

from schemas.topics import EPISODE, topic_of
from services.recordings.growing import GrowingFile, Index, OpenChunk
from services.recordings.records import (
    CHUNK_HEAD,
    HEAD,
    KEPT_FREE,
    MAGIC,
    UNREADABLE,
    Allowance,
    Fair,
    inside_of,
    mapped,
    record_of,
    walk,
)
from services.recordings.sink import Sink, claim, finished, publish
from services.recordings.survey import ChunkSearch
from services.recordings.writer import EPISODE_METADATA, GAPS_METADATA

#: What an index of messages begins with: its channel, and the bytes that its entries take.
_MESSAGE_INDEX: Final = struct.Struct("<HI")
_ENTRY: Final = 16


class LeftoverError(Exception):
    """What was left cannot be sealed, and stays as it is; the text says why in one line."""


@dataclass(frozen=True)
class Sealed:
    """A leftover that is a recording now.

    Attributes
    ----------
    path
        Its name.
    episode
        Id of its episode.
    ended
        Whether all of it is there, its end included.
    """

    path: Path
    episode: str
    ended: bool


def seal_leftover(partial: Path) -> Sealed:
    """Seal what a dead recorder left.

    Raises
    ------
    LeftoverError
        When it is not the recording of an episode, or damaged.
    OSError
        When it cannot be opened, its recorder lives (BlockingIOError), or there is no room for its end.
    """
    descriptor = claim(partial)
    try:
        found = _look_at(partial)
        sink = Sink(descriptor, found.size)
    except BaseException:
        os.close(descriptor)
        raise
    try:
        GrowingFile(sink, found.index, found.chunk, checksum=None).finish()
        path = finished(partial)
        publish(partial, path)
    finally:
        sink.close()
    return Sealed(path, found.episode, found.ended)


def _look_at(partial: Path) -> _Look:
    data = mapped(partial)
    if MAGIC.startswith(bytes(data[: len(MAGIC) + 1])):
        partial.unlink()
        raise LeftoverError("it was empty and is removed")
    found = _Look(data)
    try:
        whole = found.look()
    except UNREADABLE:
        whole = False
    if not found.episode:
        raise LeftoverError("it is not the recording of an episode")
    if not whole:
        raise LeftoverError(f"it is damaged at byte {found.size}; see smal recording repair")
    return found


class _Look:
    """Goes from chunk to chunk; what is in them is looked at only where a channel is new, and at the end.

    Attributes
    ----------
    index
        Of the chunks.
    chunk
        What is written behind the last of them.
    size
        Bytes that are whole, without what the end of a file has.
    episode
        Id of the episode; empty where the file tells none.
    ended
        Whether its end is there.
    """

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.index = Index()
        self.chunk: OpenChunk | None = None
        self.size = len(MAGIC)
        self.episode = ""
        self.ended = False

    def look(self) -> bool:
        """Look at all of it; return whether there is nothing more behind what is whole.

        What is cut off at the end was never whole; what is damaged before the end hides what is.

        Raises
        ------
        McapError, ValueError, struct.error
            When it is damaged.
        """
        if self._data[: self.size] != MAGIC:
            raise McapError("does not begin as an MCAP file")
        while self._take(self.size):
            pass
        ends = self.opcode_at(self.size) == Opcode.DATA_END
        return ends or ChunkSearch(self._data).next(self.size, len(self._data)) == len(self._data)

    def opcode_at(self, at: int) -> int | None:
        """Return what the record is that stands here, which is whole, or a chunk; None where there is none."""
        if at + HEAD.size > len(self._data):
            return None
        opcode = self._data[at]
        return opcode if opcode == Opcode.CHUNK or self._end(at) <= len(self._data) else None

    def _end(self, at: int) -> int:
        return at + HEAD.size + int(HEAD.unpack_from(self._data, at)[1])

    def _take(self, at: int) -> bool:
        """Take the record that stands here; return whether to go on behind it."""
        match self.opcode_at(at):
            case Opcode.HEADER:
                self.size = self._end(at)
                return True
            case Opcode.METADATA:
                self._take_metadata(at)
                return True
            case Opcode.CHUNK:
                return self._take_chunk(at)
            case opcode if opcode == KEPT_FREE:
                self._take_open(at, len(self._data))
        return False

    def _take_metadata(self, at: int) -> None:
        end = self.size = self._end(at)
        record = record_of(Opcode.METADATA, self._data[at + HEAD.size : end])
        assert isinstance(record, Metadata)  # noqa: S101 - by its kind
        self.index.metadata.append(MetadataIndex(offset=at, length=end - at, name=record.name))
        if record.name == EPISODE_METADATA:
            self.episode = record.metadata.get("episode", "")
        # It is the first thing that is written when an episode is over.
        self.ended |= record.name == GAPS_METADATA

    def _take_chunk(self, at: int) -> bool:
        begin = inside_of(self._data, at)
        if begin is None:
            raise McapError("a chunk that is packed, or without its head")
        end = after = self._end(at)
        if end > len(self._data):
            self._take_open(at, len(self._data))
            return False
        offsets, counts = {}, Counter[int]()
        while self.opcode_at(after) == Opcode.MESSAGE_INDEX:
            channel, size = _MESSAGE_INDEX.unpack_from(self._data, after + HEAD.size)
            offsets[channel], counts[channel] = after, size // _ENTRY
            after = self._end(after)
        if not offsets:
            self._take_open(at, end)
            return False
        if offsets.keys() - self.index.channels.keys():
            for record in walk(self._data[begin:end], 0, Fair(0, Allowance())):
                self._note(record)
        _, _, first_ns, last_ns, size, *_ = CHUNK_HEAD.unpack_from(self._data, at)
        self.index.add(
            ChunkIndex(
                chunk_length=end - at,
                chunk_start_offset=at,
                compression="",
                compressed_size=size,
                message_end_time=last_ns,
                message_index_length=after - end,
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=size,
            ),
            counts,
        )
        self.size = after
        return True

    def _take_open(self, at: int, end: int) -> None:
        """Take what stands behind the head of a chunk, or the place that is kept free for one."""
        begin = here = at + CHUNK_HEAD.size
        # After a power failure zeros may stand in place of the end of the last record.
        end = min(end, _end_without_zeros(self._data))
        chunk = OpenChunk(at)
        while self.opcode_at(here) in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE) and self._end(here) <= end:
            record = record_of(self._data[here], self._data[here + HEAD.size : self._end(here)])
            self._note(record)
            if isinstance(record, Message):
                chunk.note(record.channel_id, record.log_time, here - begin)
                channel = self.index.channels.get(record.channel_id)
                told = channel is not None and topic_of(channel.topic) is EPISODE
                self.ended |= told and b'"event":"ended"' in bytes(record.data)
            here = self._end(here)
        if chunk.entries:
            chunk.content += self._data[begin:here]
            self.chunk, self.size = chunk, here

    def _note(self, record: McapRecord | None) -> None:
        if isinstance(record, Schema):
            self.index.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.index.channels[record.id] = record


def _end_without_zeros(data: memoryview) -> int:
    """Return where the zeros begin with which it ends."""
    end = len(data)
    while end > 0 and not data[end - 1]:
        tail = bytes(data[max(0, end - mmap.PAGESIZE) : end])
        end -= len(tail) - len(tail.rstrip(b"\0"))
    return end
