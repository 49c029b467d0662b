"""Reads files of a folder that somebody else filled, and none outside of it.

Names in such a folder, and links in it, may lead anywhere: to a private file, whose content would then be in the
recording, or to a pipe that nobody ever writes to.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

from schemas.codec import printable
from services.importers.drive import ImportFailure
from services.kit.root import OutsideError, below, open_below

#: Most bytes of a file that is read as a whole; the episodes of a thousand hours are described in less.
MOST_BYTES: Final = 256 * 2**20
#: Most characters of a line; of a row of numbers it has a few hundred.
LONGEST_LINE: Final = 1_000_000


class Outside(ImportFailure):
    """A name leads out of the folder."""


class Missing(ImportFailure):
    """There is no file of that name."""


class Inside:
    """A folder, or one file, to read from.

    Parameters
    ----------
    path
        As the user gave it; a link in it is the user's own.

    Raises
    ------
    ImportFailure
        When there is nothing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._root = path.resolve(strict=True)
        except (OSError, RuntimeError) as error:
            raise ImportFailure(f"{path}: {getattr(error, 'strerror', None) or 'no such file or folder'}") from None

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder."""
        return self._root.is_dir()

    def called(self, name: str) -> str:
        """Return how a file in it is named to the user."""
        return printable(str(self.path / name if name else self.path))

    def regular(self, name: str = "") -> Path:
        """Return the path of a regular file without links, for those who open it themselves; errors as of `open`."""
        with self.open(name):
            return below(self._root, name)

    def open(self, name: str = "") -> IO[bytes]:
        """Open a file for reading.

        Raises
        ------
        Outside
            When the name, or a link, leads out of the folder.
        Missing
            When there is none.
        ImportFailure
            When it is no regular file, or cannot be read.
        """
        try:
            return open_below(self._root, name)
        except OutsideError:
            raise self._outside(name) from None
        except (FileNotFoundError, NotADirectoryError):
            raise Missing(f"{self.called(name)}: no such file") from None
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or "no file name"
            if getattr(error, "errno", None) in (errno.EISDIR, errno.EINVAL):
                why = "is no regular file"
            raise ImportFailure(f"{self.called(name)}: {why}") from None

    def _outside(self, name: str) -> Outside:
        return Outside(f"{self.called(name)} leads out of {self.path}; copy links as files first (cp -rL)")

    def read(self, name: str = "", most: int = MOST_BYTES) -> bytes:
        """Return the bytes of a file; errors are those of `open`, and one that is too large is another."""
        with self.open(name) as file:
            # As much room is made as is asked for.
            size = os.fstat(file.fileno()).st_size
            if size > most:
                raise ImportFailure(f"{self.called(name)}: larger than {most} bytes")
            return file.read(size)

    def lines(self, name: str) -> Iterator[bytes]:
        """Yield the lines of a file."""
        with self.open(name) as file:
            while line := file.readline(LONGEST_LINE + 1):
                if len(line) > LONGEST_LINE:
                    raise ImportFailure(f"{self.called(name)}: a line of more than {LONGEST_LINE} characters")
                yield line

    def names(self, folder: str = "") -> list[str]:
        """Return the names of what is in a folder, sorted; of none nothing."""
        try:
            return sorted(path.name for path in below(self._root, folder).iterdir())
        except OutsideError:
            raise self._outside(folder) from None
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise ImportFailure(f"{self.called(folder)}: {error.strerror}") from None


def parsed(data: bytes, called: str) -> Any:  # noqa: ANN401 - any JSON value
    """Return a JSON value; one that is none, or nested beyond reason, is an `ImportFailure`."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else printable(str(error))
        raise ImportFailure(f"{called}: not JSON: {reason}") from None
