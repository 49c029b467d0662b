"""Finishing a recording whose recorder did not: cut it after the last whole record, and append the index."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, cast

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema
from mcap.writer import CompressionType, Writer

from services.recordings.records import (
    MAGIC,
    Record,
    chunk_content,
    fields,
    flat_records,
    message_header,
    message_payload,
    records,
    view_of,
)
from services.recordings.sink import PARTIAL_SUFFIX, Sink, free_path, lock, publish, write_all


class RecoveryError(Exception):
    """A file cannot be finished; the text says why in one line."""


@dataclass(frozen=True)
class Recovered:
    """What became of a leftover.

    Attributes
    ----------
    partial
        The file that was found.
    path
        The recording that it became; None if it held nothing and was removed, or could not be recovered.
    problem
        Why it could not be recovered.
    """

    partial: Path
    path: Path | None = None
    problem: str | None = None


def recover(folder: Path) -> Iterator[Recovered]:
    """Finish every recording in a folder that a killed recorder left behind; those of living ones are let be."""
    for partial in leftovers(folder):
        try:
            with partial.open("r+b") as file:
                if lock(file.fileno()):
                    yield _recover(partial, file.fileno())
        except (RecoveryError, OSError) as error:
            yield Recovered(partial, problem=str(error))


def leftovers(folder: Path) -> list[Path]:
    """Return the unfinished files in a folder, those of living recorders too."""
    return sorted(folder.glob(f"*.mcap{PARTIAL_SUFFIX}"))


def finished(partial: Path) -> Path:
    """Return the name that a leftover gets; never that of another recording."""
    path = partial.with_name(partial.name.removesuffix(PARTIAL_SUFFIX))
    return free_path(path.parent, path.stem) if path.exists() else path


def _recover(partial: Path, descriptor: int) -> Recovered:
    start = os.pread(descriptor, len(MAGIC), 0)
    if MAGIC.startswith(start) and os.fstat(descriptor).st_size <= len(MAGIC):
        partial.unlink()
        return Recovered(partial)
    finish(descriptor)
    path = finished(partial)
    publish(partial, path)
    return Recovered(partial, path)


def finish(descriptor: int) -> None:
    """Cut an unfinished file after its last whole record of the data section, append the summary, and sync.

    The summary comes from the same ``Writer`` that makes it in a normal close: everything in the file is told to it
    again, and what it writes must be what the file has, and goes on after the file's end.

    Raises
    ------
    RecoveryError
        When the file was not written by this recorder; it is left as it is.
    OSError
        When there is no room for the summary; the file then ends with its last whole record.
    """
    unfinished = Unfinished.read(descriptor)
    unfinished.writer.finish()  # type: ignore[no-untyped-call]
    _append(descriptor, unfinished.end, bytes(unfinished.echo.tail))


@dataclass(frozen=True, eq=False)
class Unfinished:
    """A file without its end, and a writer that was told all of it. Nothing is changed before ``go_on``.

    Attributes
    ----------
    data
        The file up to the end of its last whole record.
    writer
        What wrote it, as it were.
    """

    data: memoryview
    writer: Writer
    echo: _Echo

    @classmethod
    def read(cls, descriptor: int) -> Self:
        """Tell a writer what a file has.

        Raises
        ------
        RecoveryError
            When the file was not written by this recorder.
        """
        try:
            data = view_of(descriptor)
        except ValueError:
            raise RecoveryError("empty") from None
        if data[: len(MAGIC)] != MAGIC:
            raise RecoveryError("not an MCAP file")
        whole = [record for record in records(data) if record.opcode != Opcode.DATA_END]
        if not whole:
            raise RecoveryError("it ends before its first record")
        try:
            return cls(data[: whole[-1].end], *_told(data, whole))
        except RecoveryError:
            # After a power failure the last record may have its length, but zeros in place of its end.
            if len(whole) == 1:
                raise
            whole.pop()
            return cls(data[: whole[-1].end], *_told(data, whole))

    @property
    def end(self) -> int:
        """Where the last whole record ends."""
        return len(self.data)

    def records(self) -> Iterator[Record]:
        """Yield what the file holds."""
        return flat_records(self.data)

    def go_on(self, sink: Sink) -> None:
        """Cut the file after its last whole record and let the writer go on there."""
        sink.truncate(self.end)
        self.echo.go_on(sink)


def _told(data: memoryview, whole: list[Record]) -> tuple[Writer, _Echo]:
    echo = _Echo(data[: whole[-1].end])
    # The writer asks its output for no more than write, tell and flush.
    writer = Writer(cast("Any", echo), compression=CompressionType.NONE)
    try:
        for record in whole:
            _tell(writer, record.opcode, record.body)
    except (McapError, ValueError, KeyError, struct.error) as error:
        raise RecoveryError(f"not written by this recorder ({error})") from None
    if echo.tell() < whole[-1].end:
        raise RecoveryError("not written by this recorder (it holds more than its messages)")
    return writer, echo


def _append(descriptor: int, end: int, tail: bytes) -> None:
    os.ftruncate(descriptor, end)
    os.lseek(descriptor, end, os.SEEK_SET)
    try:
        write_all(descriptor, tail)
    except OSError:
        os.ftruncate(descriptor, end)
        raise
    os.fsync(descriptor)


class _Echo:
    """Compares what the writer writes with what the file has, and keeps what comes after the file's end."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._position = 0
        self._sink: Sink | None = None
        self.tail = bytearray()

    def write(self, data: bytes) -> int:
        begin, self._position = self._position, self._position + len(data)
        if self._sink is not None:
            return self._sink.write(data)
        known = self._data[begin : self._position]
        if known != data[: len(known)]:
            raise ValueError(f"something else stands at byte {begin}")
        self.tail += data[len(known) :]
        return len(data)

    def go_on(self, sink: Sink) -> None:
        """Write to a file from here on: first what it lacks of what was said already."""
        sink.write(bytes(self.tail))
        self._sink, self._data, self.tail = sink, memoryview(b""), bytearray()

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Do nothing: nothing is held back."""


def _tell(writer: Writer, opcode: int, body: memoryview) -> None:
    """Tell the writer one record; it numbers schemas and channels as it did before."""
    match opcode:
        case Opcode.HEADER:
            header = Header.read(fields(body))
            writer.start(header.profile, header.library)
        case Opcode.METADATA:
            metadata = Metadata.read(fields(body))
            writer.add_metadata(metadata.name, metadata.metadata)
        case Opcode.CHUNK:
            for record in records(chunk_content(body), start=0):
                _tell(writer, record.opcode, record.body)
            writer.flush()  # type: ignore[no-untyped-call]
        case Opcode.SCHEMA:
            schema = Schema.read(fields(body))
            writer.register_schema(schema.name, schema.encoding, schema.data)
        case Opcode.CHANNEL:
            channel = Channel.read(fields(body))
            writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id, channel.metadata)
        case Opcode.MESSAGE:
            message, payload = message_header(body), bytes(message_payload(body))
            writer.add_message(message.channel_id, message.log_time, payload, message.publish_time, message.sequence)
        case Opcode.MESSAGE_INDEX:
            # The writer makes it of the chunk before.
            pass
        case _:
            raise ValueError(f"a record of kind {opcode}")
