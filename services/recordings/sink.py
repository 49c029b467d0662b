"""The files of a recording, and one that survives what happens to it: written at once, on the disk within a second.

A recording is ``NAME.mcap.partial`` until it is finished. A recorder that finds what a killed one left goes on in
``NAME.mcap.partial-2``, the next in ``-3``: parts of one recording, which become one file at its end. Who has locked
the first part owns them all.
"""

from __future__ import annotations

import fcntl
import glob
import os
import threading
from pathlib import Path
from typing import Final

from smal.regular_file import open_regular

PARTIAL_SUFFIX: Final = ".partial"
SYNC_PERIOD_S: Final = 1.0


def claim(path: Path, flags: int = os.O_RDWR) -> int:
    """Open and lock a file that is being recorded; the lock goes with the descriptor. A dead process holds none.

    Raises
    ------
    BlockingIOError
        When another recorder holds it.
    OSError
        When it cannot be opened, or is no regular file.
    """
    descriptor = open_regular(path, flags)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # In between another recorder may have put something else in its place.
        if not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise BlockingIOError(f"{path} is being recorded")
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def is_being_recorded(path: Path) -> bool:
    """Whether a living recorder writes this recording."""
    try:
        os.close(claim(path, os.O_RDONLY))
    except BlockingIOError:
        return True
    return False


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


def finished(partial: Path) -> Path:
    """Return the name that a leftover gets; never that of another recording."""
    path = partial.with_name(partial.name.removesuffix(PARTIAL_SUFFIX))
    return free_path(path.parent, path.stem) if path.exists() else path


def leftovers(folder: Path) -> list[Path]:
    """Return the first parts of the unfinished recordings in a folder, those of living recorders too; never a link."""
    return sorted(part for part in folder.glob(f"*.mcap{PARTIAL_SUFFIX}") if not part.is_symlink())


def parts_of(path: Path) -> list[Path]:
    """Return the files of a recording in their order: an unfinished one has more where its recorder was killed."""
    if path.suffix != PARTIAL_SUFFIX:
        return [path]
    others = (part for part in path.parent.glob(f"{glob.escape(path.name)}-*") if not part.is_symlink())
    return [path, *sorted(others, key=lambda part: (len(part.name), part.name))]


def next_part(first: Path) -> Path:
    """Return the name of another part of a recording."""
    number = 2
    while (part := first.with_name(f"{first.name}-{number}")).exists():
        number += 1
    return part


def publish(partial: Path, path: Path) -> None:
    """Give a finished recording its name, and make the name itself durable."""
    partial.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class Sink:
    """An unbuffered new file being recorded; what ``mcap.writer.Writer`` writes to.

    A killed process loses nothing that was written, and a machine without power at most the last second.

    Raises
    ------
    OSError
        When the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = claim(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._size = 0
        self._closed = threading.Event()
        self._syncer = threading.Thread(target=self._sync_often, name=f"sync {path.name}", daemon=True)
        self._syncer.start()

    def write(self, data: bytes) -> int:
        """Append all of ``data``, however many calls of the system that takes."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self._size

    def flush(self) -> None:
        """Do nothing: nothing is held back."""

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
