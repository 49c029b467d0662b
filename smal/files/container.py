"""Container of JSON and arrays in one file: no pickle, no execution, every byte under a checksum.

Layout: 8 bytes magic, format version (uint32), length of the header (uint64), both little endian; the header in
UTF-8 JSON ({"meta": ..., "arrays": [[name, dtype, shape], ...]}), padded with spaces to a multiple of 8 bytes; the
arrays in a row, the largest items first, so that all are aligned, C order, little endian; 32 bytes SHA-256 of all bytes
before.

A file is read once, into immutable memory, and the checksum is computed on these very bytes (`smal.files.held`). Arrays
are views of it. All processes of a machine share one copy.
"""

import errno
import hashlib
import json
import math
import os
import stat
import struct
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from smal.arrays import AnyArray
from smal.files.held import held

MAGIC = b"SMAL\x00MDL"
_FIXED = struct.Struct("<8sIQ")
_ALIGNED = 8
_DIGEST = 32  # Bytes of the checksum.
LARGEST = 2**33  # Maximum bytes of a model: the map of 150 km.
#: Maximum bytes of its header. Parsing takes 30 times as much memory; a demonstration takes 100 bytes.
LARGEST_HEADER = 2**24
_MOST_AXES = 8
#: Errors of a full disk, a quota, and a limit of a process.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DTYPES = {
    name: np.dtype(name) for name in ("<f2", "<f4", "<f8", "<i8", "<i4", "|i1", "|u1", "|b1")
}


class ModelError(ValueError):
    """A file is not a usable model; the message is one line."""


class NoModelError(ModelError):
    """A file cannot be opened, is too large, or does not begin like a model."""


def one_line(error: Exception) -> str:
    """Return the beginning of an error's message, with control characters of untrusted files replaced."""
    text = f"missing {error}" if isinstance(error, KeyError) else str(error)
    return "".join(c if c.isprintable() else "?" for c in text[:200])


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Replace a file atomically; a link is followed."""
    path = path.resolve()
    with tempfile.NamedTemporaryFile(
        dir=path.parent, prefix=f".{path.name}.", delete=False
    ) as file:
        try:
            yield file
            file.flush()
            os.fsync(file.fileno())
            # A temporary file is private; services of another user must be able to read a model.
            Path(file.name).chmod(0o644)
            Path(file.name).replace(path)
        except BaseException as error:
            Path(file.name).unlink(missing_ok=True)
            if isinstance(error, OSError) and error.errno in FULL:
                error.filename = str(path)  # Without room, the system reports no file.
            raise


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as `replacing` does."""
    with replacing(path) as file:
        file.write(content)


def write(
    path: Path, version: int, meta: Mapping[str, Any], arrays: Mapping[str, AnyArray]
) -> None:
    """Write a file atomically; ModelError if it is too large for reading."""
    size = sum(array.nbytes for array in arrays.values())
    if size > LARGEST - LARGEST_HEADER:
        raise ModelError(
            f"{path}: a model of {size / 1e9:.1f} GB, at most {LARGEST / 1e9:.1f} GB; learn fewer drives"
        )
    parts = _parts(version, meta, arrays)
    digest = hashlib.sha256()
    with replacing(path) as file:
        for part in parts:
            digest.update(part)
            file.write(part)
        file.write(digest.digest())


def checksum(version: int, meta: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> str:
    """Return the SHA-256, in hex, at the end of a file with this content."""
    digest = hashlib.sha256()
    for part in _parts(version, meta, arrays):
        digest.update(part)
    return digest.hexdigest()


def read(
    file: IO[bytes], name: str, version: int
) -> tuple[dict[str, Any], dict[str, AnyArray], str]:
    """Read a file of a version of the format: its metadata, its arrays, and its checksum in hex.

    NoModelError if the file, called `name` in errors, cannot be read, is too large, or is of another kind.
    ModelError if it has another version, or is truncated or altered.
    """
    with _explained(name):
        size = os.fstat(file.fileno()).st_size
        if size > LARGEST:
            raise NoModelError(f"{name}: too large for a model: {size} bytes, at most {LARGEST}")
        # Checked before memory is allocated for the rest.
        _header_size(file.read(_FIXED.size), name, version)
        file.seek(max(size - _DIGEST, 0))
        content = held(file, size, file.read(_DIGEST).hex(), _is_whole)
        if content is None:
            raise ModelError(f"{name}: truncated or altered: its checksum does not match")
        header_size = _header_size(bytes(content[: _FIXED.size]), name, version)
        body = content[:-_DIGEST]
        header = json.loads(bytes(body[_FIXED.size : _FIXED.size + header_size]))
        arrays = _arrays(header["arrays"], body[_FIXED.size + header_size :])
        return header["meta"], arrays, bytes(content[-_DIGEST:]).hex()


def _is_whole(content: memoryview) -> bool:
    return hashlib.sha256(content[:-_DIGEST]).digest() == content[-_DIGEST:]


def read_meta(file: IO[bytes], name: str, version: int) -> dict[str, Any]:
    """Read the metadata of a file, without its arrays and unchecked; ModelError if they are invalid."""
    with _explained(name):
        meta = json.loads(file.read(_header_size(file.read(_FIXED.size), name, version)))["meta"]
        if not isinstance(meta, dict):
            raise TypeError("the metadata are missing")
        return meta


@contextmanager
def _explained(name: str) -> Iterator[None]:
    """Convert errors of reading a file to one-line errors."""
    try:
        yield
    except ModelError:
        raise
    except OSError as error:
        raise NoModelError(f"{name}: cannot be read: {error.strerror}") from error
    except (LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise ModelError(
            f"{name}: the header does not describe a model: {one_line(error)}"
        ) from error


def _header_size(fixed: bytes, name: str, version: int) -> int:
    """Check the beginning of a file, and return the length of the header."""
    if len(fixed) < _FIXED.size or not fixed.startswith(MAGIC):
        raise NoModelError(f"{name}: not a SMAL model")
    _, found, size = _FIXED.unpack(fixed)
    if found != version:
        raise ModelError(
            f"{name}: model of format {found}, this program reads format {version}; learn it again"
        )
    if size > LARGEST_HEADER:
        raise ModelError(f"{name}: a header of {size} bytes, at most {LARGEST_HEADER} are read")
    return int(size)


def _parts(
    version: int, meta: Mapping[str, Any], arrays: Mapping[str, AnyArray]
) -> list[bytes | memoryview]:
    """Return the bytes of the file in order, without its checksum."""
    in_order = sorted(arrays.items(), key=lambda item: -item[1].itemsize)
    stored = {name: np.ascontiguousarray(array) for name, array in in_order}
    table = [[name, array.dtype.str, list(array.shape)] for name, array in stored.items()]
    unknown = [row for row in table if row[1] not in _DTYPES]
    if unknown:
        raise TypeError(f"arrays of this type are not stored in a model: {unknown}")
    header = json.dumps({"meta": meta, "arrays": table}, allow_nan=False).encode()
    header += b" " * (-(_FIXED.size + len(header)) % _ALIGNED)
    return [
        _FIXED.pack(MAGIC, version, len(header)),
        header,
        *(array.reshape(-1).data for array in stored.values()),
    ]


def _arrays(table: list[tuple[str, str, list[int]]], body: memoryview) -> dict[str, AnyArray]:
    arrays: dict[str, AnyArray] = {}
    at = 0
    for name, dtype, shape in table:
        if not isinstance(name, str):
            raise TypeError(f"the name of an array must be a string, got {name!r}")
        if len(shape) > _MOST_AXES or not all(map(_is_length, shape)):
            raise ValueError(f"no shape of an array: {str(shape)[:100]}")
        kind = _DTYPES[dtype]
        count = math.prod(shape)
        array = np.empty(0, kind)
        if count:
            array = np.frombuffer(body, dtype=kind, count=count, offset=at)
        arrays[name] = array.reshape(shape)
        at += array.nbytes
    if at != len(body):
        raise ValueError("its arrays do not fill the file")
    return arrays


def _is_length(length: object) -> bool:
    return type(length) is int and 0 <= length <= LARGEST


def open_regular(path: Path, flags: int = os.O_RDONLY) -> int:
    """Open a regular file, as `os.open` does, without waiting for a FIFO; return its descriptor, or raise OSError."""
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC, 0o644)
    kind = os.fstat(descriptor).st_mode
    if stat.S_ISREG(kind):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(kind):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "Not a regular file", str(path))
