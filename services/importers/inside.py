"""Access to the files of a foreign folder, never to files outside, whatever its links."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final, TypeVar
from unicodedata import normalize

from pydantic import BaseModel, ValidationError

from schemas.codec import describe, printable
from services.importers.drive import ImportFailure
from services.kit.root import OutsideError, below, open_below

#: Maximum size of a file that is read as a whole; metadata of a thousand hours are smaller.
MOST_BYTES: Final = 256 * 2**20
LONGEST_LINE: Final = 1_000_000  # In characters; a row of numbers has a few hundred.
_DEEPEST: Final = 3  # The tubs of a car are in its folder data/; a folder above can have all cars.
Model = TypeVar("Model", bound=BaseModel)


class Inside:
    """A folder or a file to read from; its own path can contain links."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._failures(""):
            self._root = path.resolve(strict=True)
        self.is_folder = self._root.is_dir()
        self._spellings: dict[str, dict[str, str]] = {}

    def called(self, name: str) -> str:
        """Return the name of a file in the folder, for messages."""
        return printable(str(self.path / name if name else self.path))

    def regular(self, name: str = "") -> Path:
        """Return the path of a regular file without links; raise errors as `open` does."""
        with self.open(name):
            return below(self._root, name)

    def open(self, name: str = "") -> IO[bytes]:
        """Open a file; raise ImportFailure if it is outside the folder, irregular or unreadable."""
        with self._failures(name):
            return open_below(self._root, name)

    @contextmanager
    def _failures(self, name: str) -> Iterator[None]:
        try:
            yield
        except OutsideError:
            raise ImportFailure(
                f"{self.called(name)} leads out of {self.path}; copy links as files first (cp -rL)"
            ) from None
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or "no file name"
            raise ImportFailure(f"{self.called(name)}: {why}") from None

    def read(self, name: str = "", most: int = MOST_BYTES) -> bytes:
        """Return the bytes of a file; raise errors as `open` does, or if it is too large."""
        with self.open(name) as file:
            size = os.fstat(file.fileno()).st_size  # read() allocates the size that it is given.
            if size > most:
                raise ImportFailure(f"{self.called(name)}: too large (more than {most} bytes)")
            return file.read(size)

    def lines(self, name: str) -> Iterator[bytes]:
        """Yield the lines of a file."""
        with self.open(name) as file:
            while line := file.readline(LONGEST_LINE + 1):
                if len(line) > LONGEST_LINE:
                    raise ImportFailure(
                        f"{self.called(name)}: line too long (more than {LONGEST_LINE} characters)"
                    )
                yield line

    def names(self, folder: str = "") -> list[str]:
        """Return the sorted names in a folder; [] if it is not a folder."""
        with self._failures(folder):
            path = below(self._root, folder)
            return sorted(each.name for each in path.iterdir()) if path.is_dir() else []

    def folders(self, folder: str = "") -> list[str]:
        """Return the sorted names of the folders in a folder, without links."""
        with self._failures(folder):
            path = below(self._root, folder)
            return sorted(
                each.name for each in path.iterdir() if each.is_dir() and not each.is_symlink()
            )

    def search(self, is_there: Callable[[list[str]], bool], folder: str = "") -> Iterator[str]:
        """Yield the folders whose names are a source: "", or names that end with a slash."""
        names = self.names(folder)
        if is_there(names):
            yield folder
        elif folder.count("/") < _DEEPEST:
            for name in self.folders(folder):
                yield from self.search(is_there, f"{folder}{name}/")

    def spelled(self, name: str) -> str:
        """Return a file's name as its folder has it: case, accents and slashes differ by system."""
        folder, slash, last = name.replace("\\", "/").rpartition("/")
        if folder not in self._spellings:
            self._spellings[folder] = {_alike(found): found for found in self.names(folder)}
        return f"{folder}{slash}{self._spellings[folder].get(_alike(last), last)}"

    def parsed(self, model: type[Model], data: bytes, name: str) -> Model:
        """Parse the JSON of a file or a line; ImportFailure if it does not fit the model."""
        try:
            return model.model_validate_json(data)
        except ValidationError as error:
            raise ImportFailure(
                f"{self.called(name)}: {describe(error).removeprefix('message: ')}"
            ) from None


def _alike(name: str) -> str:
    return normalize("NFC", name).casefold()
