"""Reads files of a stranger's folder, and none outside of it, wherever names and links in it may lead."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final, TypeVar

from pydantic import BaseModel, ValidationError

from schemas.codec import describe, printable
from services.importers.drive import ImportFailure
from services.kit.root import OutsideError, below, open_below

MOST_BYTES: Final = (
    256 * 2**20
)  # Most of a file read as a whole; a thousand hours are described in less.
LONGEST_LINE: Final = (
    1_000_000  # Most characters of a line; of a row of numbers it has a few hundred.
)
Model = TypeVar("Model", bound=BaseModel)


class Inside:
    """A folder, or one file, to read from, whose own path may have links; ImportFailure where there is nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._failures(""):
            self._root = path.resolve(strict=True)
        self.is_folder = self._root.is_dir()

    def called(self, name: str) -> str:
        """Return how a file in it is named to the user."""
        return printable(str(self.path / name if name else self.path))

    def regular(self, name: str = "") -> Path:
        """Return the path of a regular file without links, for those who open it themselves; errors as of `open`."""
        with self.open(name):
            return below(self._root, name)

    def open(self, name: str = "") -> IO[bytes]:
        """Open a file; ImportFailure when it is outside of the folder, no regular file, or cannot be read."""
        with self._failures(name):
            return open_below(self._root, name)

    @contextmanager
    def _failures(self, name: str) -> Iterator[None]:
        try:
            yield
        except OutsideError:
            said = (
                f"{self.called(name)} leads out of {self.path}; copy links as files first (cp -rL)"
            )
            raise ImportFailure(said) from None
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or "no file name"
            raise ImportFailure(f"{self.called(name)}: {why}") from None

    def read(self, name: str = "", most: int = MOST_BYTES) -> bytes:
        """Return the bytes of a file; errors are those of `open`, and one that is too large is another."""
        with self.open(name) as file:
            size = os.fstat(file.fileno()).st_size  # As much room is made as is asked for.
            if size > most:
                raise ImportFailure(f"{self.called(name)}: larger than {most} bytes")
            return file.read(size)

    def lines(self, name: str) -> Iterator[bytes]:
        """Yield the lines of a file."""
        with self.open(name) as file:
            while line := file.readline(LONGEST_LINE + 1):
                if len(line) > LONGEST_LINE:
                    raise ImportFailure(
                        f"{self.called(name)}: a line of more than {LONGEST_LINE} characters"
                    )
                yield line

    def names(self, folder: str = "") -> list[str]:
        """Return the names of what is in a folder, sorted; of none nothing."""
        with self._failures(folder):
            path = below(self._root, folder)
            return sorted(each.name for each in path.iterdir()) if path.is_dir() else []

    def parsed(self, model: type[Model], data: bytes, name: str) -> Model:
        """Return the JSON of a file, or of a line of it, as a model of pydantic; all else is an `ImportFailure`."""
        try:
            return model.model_validate_json(data)
        except ValidationError as error:
            raise ImportFailure(
                f"{self.called(name)}: {describe(error).removeprefix('message: ')}"
            ) from None
