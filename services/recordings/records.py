"""The records of an MCAP file, one after the other, as far as they are whole."""

from __future__ import annotations

import mmap
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, cast

from lz4.frame import LZ4FrameDecompressor
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Chunk, DataEnd, McapRecord
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError

from schemas.codec import printable

#: First and last bytes of every MCAP file.
MAGIC: Final = MCAP0_MAGIC
#: Most bytes that a packed chunk may unpack to; other tools make chunks of a few megabytes.
_LARGEST_CHUNK: Final = 256 * 1024 * 1024


def mapped(path: Path) -> memoryview:
    """Return a file's bytes without reading them; parts of it are read where they are looked at.

    Raises
    ------
    OSError
        When the file cannot be opened.
    """
    with path.open("rb") as file:
        empty = os.fstat(file.fileno()).st_size == 0
        return memoryview(b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def records(data: memoryview, *, checked: bool = False) -> Iterator[McapRecord]:
    """Yield the whole records of the data section, those inside chunks in place of their chunk.

    Parameters
    ----------
    data
        A file's bytes, or those that a killed recorder left of it.
    checked
        Whether to leave out chunks whose checksum is wrong: after a power failure the last ones may have zeros in place
        of their end. It takes the whole file to be read, images too.

    Raises
    ------
    McapError, ValueError, struct.error
        When the file is damaged otherwise.
    """
    for record in _records(data):
        if not isinstance(record, Chunk):
            yield record
        elif record.compression:
            yield from _records(memoryview(_unpacked(record)), inside=True)
        elif not checked or record.uncompressed_crc in (0, zlib.crc32(record.data)):
            yield from _records(memoryview(record.data), inside=True)


def _records(data: memoryview, *, inside: bool = False) -> Iterator[McapRecord]:
    # The reader asks its input for no more than to read.
    stream = cast("Any", _Slices(data))
    try:
        for record in StreamReader(stream, skip_magic=inside, emit_chunks=True, record_size_limit=None).records:
            if isinstance(record, DataEnd):
                return
            yield record
    except EndOfFile:
        return


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


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack a chunk, never more of it than it announces: a few bytes can be packed that fill any memory."""
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise McapError(f"a chunk of {size} bytes, at most {_LARGEST_CHUNK} are read")
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
