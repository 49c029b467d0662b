"""Immutable copies of file contents in memory: later writes to the file do not reach them.

On Linux the copy is a sealed memory file (memfd), which the kernel makes read-only. Its name contains a digest of the
content. A process of the same user that reads the same content finds the copy under /proc and maps it too, so that
the processes of a machine share one copy.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from mmap import mmap
from pathlib import Path
from typing import IO, Final

_LINUX: Final = hasattr(os, "memfd_create")
if _LINUX:
    from fcntl import (
        F_ADD_SEALS,
        F_GET_SEALS,
        F_SEAL_GROW,
        F_SEAL_SEAL,
        F_SEAL_SHRINK,
        F_SEAL_WRITE,
        fcntl,
    )
    from mmap import MAP_PRIVATE, PROT_READ

    _SEALS: Final = F_SEAL_SEAL | F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_WRITE
#: Bytes of one copy step: few calls, and little memory beside the copy.
_BLOCK: Final = 2**20

Check = Callable[[memoryview], bool]


def held(file: IO[bytes], size: int, digest: str, check: Check) -> memoryview | None:
    """Copy the first bytes of a file into memory, or share the copy of another process.

    Parameters
    ----------
    file : IO[bytes]
        The open file, at any position.
    size : int
        Bytes to copy.
        Digest that the file contains; copies are shared under this name.
        Digest that the file claims for its content; copies are shared under this name.
        Returns whether the content has that digest. It receives the returned bytes themselves.
        Returns whether the content has that digest. It is called with the very bytes that are returned.

    Returns
    -------
    memoryview or None
        The read-only bytes; None if they fail the check.
    """
    if not _LINUX:
        own = _copied(file, size)
        return own if check(own) else None
    name = f"smal-{digest}"
    descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        own = _sealed(file, size, descriptor)
        if not check(own):
            return None
        # Processes that start together must choose the same copy: the oldest.
        return next(filter(check, _older(name, os.fstat(descriptor))), own)
    finally:
        # The map has its own descriptor, by which other processes find the copy.
        os.close(descriptor)


def _sealed(file: IO[bytes], size: int, descriptor: int) -> memoryview:
    with os.fdopen(descriptor, "wb", closefd=False) as copy:
        for block in _blocks(file, size):
            copy.write(block)
        # If the file has become shorter, the copy is padded, and fails its check.
        copy.truncate(size)
    fcntl(descriptor, F_ADD_SEALS, _SEALS)
    return _mapped(descriptor, size)


def _older(name: str, own: os.stat_result) -> Iterator[memoryview]:
    """Yield older sealed copies with that name and size, of processes of this user."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):
            if not str(link.readlink()).startswith(f"/memfd:{name} "):
                continue
            descriptor = os.open(link, os.O_RDONLY | os.O_CLOEXEC)
            try:
                found = os.fstat(descriptor)
                older = (found.st_mtime_ns, found.st_ino) < (own.st_mtime_ns, own.st_ino)
                same_size = found.st_size == own.st_size
                if older and same_size and fcntl(descriptor, F_GET_SEALS) == _SEALS:
                    yield _mapped(descriptor, found.st_size)
            finally:
                os.close(descriptor)


def _mapped(descriptor: int, size: int) -> memoryview:
    # Kernels before 6.7 reject a shared map of a sealed file.
    return memoryview(mmap(descriptor, size, flags=MAP_PRIVATE, prot=PROT_READ))


def _copied(file: IO[bytes], size: int) -> memoryview:
    copy = mmap(-1, size)
    for block in _blocks(file, size):
        copy.write(block)
    return memoryview(copy).toreadonly()


def _blocks(file: IO[bytes], size: int) -> Iterator[bytes]:
    file.seek(0)
    while size > 0 and (block := file.read(min(size, _BLOCK))):
        size -= len(block)
        yield block
