"""Finishing a recording whose recorder did not: cut it after the last whole record, and append the index."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema
from mcap.writer import Writer

from services.recorder.records import MAGIC, fields, message_header, records, view_of
from services.recorder.sink import PARTIAL_SUFFIX, free_path, lock, publish, write_all


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
    for partial in sorted(folder.glob(f"*.mcap{PARTIAL_SUFFIX}")):
        try:
            with partial.open("r+b") as file:
                if lock(file.fileno()):
                    yield _recover(partial, file.fileno())
        except (RecoveryError, OSError) as error:
            yield Recovered(partial, problem=str(error))


def _recover(partial: Path, descriptor: int) -> Recovered:
    start = os.pread(descriptor, len(MAGIC), 0)
    if MAGIC.startswith(start) and os.fstat(descriptor).st_size <= len(MAGIC):
        partial.unlink()
        return Recovered(partial)
    finish(descriptor)
    path = partial.with_name(partial.name.removesuffix(PARTIAL_SUFFIX))
    if path.exists():
        path = free_path(path.parent, path.stem)
    publish(partial, path)
    return Recovered(partial, path)


def finish(descriptor: int) -> None:
    """Cut an unfinished file after its last whole record of the data section, append the summary, and sync.

    The summary comes from the same ``Writer`` that makes it in a normal close: everything in the file is told to it
    again, while its output goes nowhere.

    Raises
    ------
    RecoveryError
        When the file was not written by this recorder.
    OSError
        When there is no room for the summary; the file then ends with its last whole record.
    """
    sink = _ReplaySink(descriptor)
    # The writer asks its output for no more than write, tell and flush.
    writer = Writer(cast("Any", sink), use_chunking=False)
    end = _replay(view_of(descriptor), writer, sink)
    os.ftruncate(descriptor, end)
    sink.begin(end)
    try:
        writer.finish()  # type: ignore[no-untyped-call]
    except OSError:
        os.ftruncate(descriptor, end)
        raise
    os.fsync(descriptor)


class _ReplaySink:
    """Takes what the writer writes: nowhere at first, then to the end of the file."""

    def __init__(self, descriptor: int) -> None:
        self.position = 0
        self._descriptor = descriptor
        self._live = False

    def begin(self, position: int) -> None:
        """Write from now on, from this position."""
        os.lseek(self._descriptor, position, os.SEEK_SET)
        self.position, self._live = position, True

    def write(self, data: bytes) -> int:
        if self._live:
            write_all(self._descriptor, data)
            self.position += len(data)
        return len(data)

    def tell(self) -> int:
        return self.position

    def flush(self) -> None:
        """Do nothing: nothing is held back."""


def _replay(data: memoryview, writer: Writer, sink: _ReplaySink) -> int:
    """Tell the writer every whole record of the data section; return where the last one ends."""
    if data[: len(MAGIC)] != MAGIC:
        raise RecoveryError("not an MCAP file")
    end = len(MAGIC)
    try:
        for record in records(data):
            if record.opcode == Opcode.DATA_END:
                break
            sink.position = record.offset
            _tell(writer, record.opcode, record.body)
            end = record.end
    except (McapError, ValueError, KeyError, struct.error) as error:
        raise RecoveryError(f"not written by this recorder ({error})") from None
    if end == len(MAGIC):
        raise RecoveryError("it ends before its first record")
    return end


def _tell(writer: Writer, opcode: int, body: memoryview) -> None:
    match opcode:
        case Opcode.HEADER:
            header = Header.read(fields(body))
            writer.start(header.profile, header.library)
        case Opcode.SCHEMA:
            schema = Schema.read(fields(body))
            _expect(writer.register_schema(schema.name, schema.encoding, schema.data), schema.id)
        case Opcode.CHANNEL:
            channel = Channel.read(fields(body))
            number = writer.register_channel(
                channel.topic, channel.message_encoding, channel.schema_id, channel.metadata
            )
            _expect(number, channel.id)
        case Opcode.MESSAGE:
            message = message_header(body)
            writer.add_message(message.channel_id, message.log_time, b"", message.publish_time, message.sequence)
        case Opcode.METADATA:
            metadata = Metadata.read(fields(body))
            writer.add_metadata(metadata.name, metadata.metadata)
        case _:
            raise ValueError(f"a record of kind {opcode}")


def _expect(number: int, expected: int) -> None:
    if number != expected:
        raise ValueError(f"record number {expected} where {number} follows")
