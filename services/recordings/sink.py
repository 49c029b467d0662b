"""File of a recording: ``NAME.mcap.partial`` until it is sealed, locked by its owner."""

import fcntl
import os
import threading
from pathlib import Path
from typing import Final

from smal.files.container import open_regular

PARTIAL_SUFFIX: Final = ".partial"
SYNC_PERIOD_S: Final = 1.0


def claim(path: Path, flags: int = os.O_RDWR) -> int:
    """Open and lock a file that is being recorded; the lock ends with the descriptor.

    Raises
    ------
    BlockingIOError
        If another recorder holds the lock.
    OSError
        If the file cannot be opened or is not a regular file.
    """
    descriptor = open_regular(path, flags)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Another recorder can have replaced the file meanwhile.
        if not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise BlockingIOError(f"{path} is being recorded")
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def free_path(folder: Path, stem: str) -> Path:
    """Return ``<stem>.mcap`` in a folder, or the first free ``<stem>-2.mcap`` and so on."""
    number = 1
    path = folder / f"{stem}.mcap"
    while path.exists() or partial_of(path).exists():
        number += 1
        path = folder / f"{stem}-{number}.mcap"
    return path


def first_of(path: Path) -> Path | None:
    """Return the recording of the same name without ``-2`` and so on, if it exists."""
    stem, dash, number = path.name.partition(".")[0].rpartition("-")
    first = path.with_name(f"{stem}.mcap")
    return first if dash and number.isdecimal() and first.exists() else None


def partial_of(path: Path) -> Path:
    """Return the name of a recording before it is sealed."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def finished(partial: Path) -> Path:
    """Return the final name of a leftover, which is never the name of another recording."""
    path = partial.with_name(partial.name.removesuffix(PARTIAL_SUFFIX))
    return free_path(path.parent, path.stem) if path.exists() else path


def leftovers(folder: Path) -> set[Path]:
    """Return the unsealed recordings in a folder without links, also of running recorders."""
    return {part for part in folder.glob(f"*.mcap{PARTIAL_SUFFIX}") if not part.is_symlink()}


def publish(partial: Path, path: Path) -> None:
    """Give a sealed recording its name, durably."""
    partial.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class Sink:
    """A file being recorded, with a descriptor from `claim`; a thread syncs it every second."""

    def __init__(self, descriptor: int, size: int = 0) -> None:
        self._descriptor = descriptor
        self._size = os.lseek(descriptor, size, os.SEEK_SET)
        os.ftruncate(descriptor, size)
        self._closed = threading.Event()
        self._syncer = threading.Thread(target=self._sync_often, name="sync", daemon=True)
        self._syncer.start()

    def write(self, data: bytes) -> None:
        """Append ``data``; raise OSError if the disk is full, perhaps after a part is written."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._size += len(data)

    def tell(self) -> int:
        """Return the number of written bytes."""
        return self._size

    def flush(self) -> None:
        """Do nothing: all writes are unbuffered."""

    def sync(self) -> None:
        """Wait until everything is on the disk."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        self._closed.set()
        self._syncer.join()
        os.close(self._descriptor)

    def _sync_often(self) -> None:
        while not self._closed.wait(SYNC_PERIOD_S):
            try:
                os.fsync(self._descriptor)
            except OSError:
                # The next write, or the sync before the final name, raises the error again.
                return
