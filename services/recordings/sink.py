"""A file that survives what happens to it: every write reaches the system at once, and the disk within a second."""

from __future__ import annotations

import fcntl
import os
import threading
from pathlib import Path
from typing import Final

PARTIAL_SUFFIX: Final = ".partial"
SYNC_PERIOD_S: Final = 1.0


def lock(descriptor: int) -> bool:
    """Lock a file that is being recorded; False where another recorder holds it. A dead process holds nothing."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_being_recorded(path: Path) -> bool:
    """Whether a living recorder writes this file."""
    with path.open("rb") as file:
        return not lock(file.fileno())


def free_path(folder: Path, stem: str) -> Path:
    """Return ``<stem>.mcap`` in a folder, or ``<stem>-2.mcap`` and so on: no recording is ever overwritten."""
    for number in range(1, 1_000_000):
        path = folder / (f"{stem}.mcap" if number == 1 else f"{stem}-{number}.mcap")
        if not path.exists() and not partial_of(path).exists():
            return path
    raise FileExistsError(f"{folder} is full of recordings named {stem}")


def partial_of(path: Path) -> Path:
    """Return the name that a recording has until it is finished."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def publish(partial: Path, path: Path) -> None:
    """Give a finished recording its name, and make the name itself durable."""
    partial.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_all(descriptor: int, data: bytes) -> None:
    """Write all of ``data``, however many calls of the system that takes."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


class Sink:
    """An unbuffered file being recorded; what ``mcap.writer.Writer`` writes to.

    A killed process loses nothing that was written, and a machine without power at most the last second.

    Parameters
    ----------
    path
        The file.
    new
        Whether to make it, or to go on with one that is there.

    Raises
    ------
    BlockingIOError
        When another recorder writes it.
    OSError
        When the file cannot be made or opened.
    """

    def __init__(self, path: Path, *, new: bool = True) -> None:
        flags = os.O_CREAT | os.O_EXCL if new else 0
        self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | flags, 0o644)
        if not lock(self._descriptor):
            os.close(self._descriptor)
            raise BlockingIOError(f"{path} is being recorded")
        self.path = path
        self._size = os.lseek(self._descriptor, 0, os.SEEK_END)
        self._closed = threading.Event()
        self._syncer = threading.Thread(target=self._sync_often, name=f"sync {path.name}", daemon=True)
        self._syncer.start()

    def write(self, data: bytes) -> int:
        """Append all of ``data``."""
        write_all(self._descriptor, data)
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self._size

    def flush(self) -> None:
        """Do nothing: nothing is held back."""

    def truncate(self, size: int) -> None:
        """Forget everything after the first ``size`` bytes."""
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self._size = size

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._descriptor

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
                # The next write, or the sync before the file gets its name, says so where it can be handled.
                return
