"""Folders for what lies on the disk for a while, of which none is left behind for good."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

PREFIX: Final = "smal-console-"


class Folder:
    """A folder that is gone when it is closed; where its process was killed before, when the next one starts.

    Attributes
    ----------
    path
        The folder.
    lock
        Descriptor that says that it is in use, for as long as anybody holds it open.

    Raises
    ------
    OSError
        When there is no room for it.
    """

    def __init__(self) -> None:
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
            self.lock = _opened(self.path)
            fcntl.flock(self.lock, fcntl.LOCK_EX)
            if self.path.exists():
                break
            os.close(self.lock)  # a console that started just then has taken it for left over

    def close(self) -> None:
        """Remove it."""
        try:
            shutil.rmtree(self.path)
        finally:
            os.close(self.lock)


def remove_left_over() -> None:
    """Remove the folders of consoles that were killed; not those that somebody uses."""
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # somebody else's, in use, or gone
            lock = _opened(path)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path)
            finally:
                os.close(lock)


def _opened(folder: Path) -> int:
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
