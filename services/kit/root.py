"""The folder below which a service reads and writes what others name; nobody on the bus reaches anything else."""

import os
from pathlib import Path
from typing import IO, Annotated, Final

from pydantic import AfterValidator

from services.kit.settings import ServiceSettings
from smal.files.container import open_regular

#: Folder below the root of the worlds that were made from maps: the console makes them, the simulator opens them.
WORLDS: Final = "worlds"


def _folder(path: Path) -> Path:
    if not path.is_dir():
        raise ValueError(f"{path}: no such folder")
    return path.resolve()


class RootSettings(ServiceSettings):
    """Where the files are that others may name."""

    root: Annotated[Path, AfterValidator(_folder)] = Path()
    """Folder of the files that calls may name, by their path below it; by default the one that it was started in."""


class OutsideError(OSError):
    """A name leads out of the root, by a link."""


def below(root: Path, name: str) -> Path:
    """Return the path of a name below a root, without links; so is the root's own path.

    The name was checked by ``schemas.rpc``: it is relative, with no way up; empty for the root itself. Raises
    OutsideError when a link leads out of the root, OSError when there is a loop of links.
    """
    path = Path(os.path.realpath(root / name))
    if not path.is_relative_to(root):
        raise OutsideError(f"leads out of {root}, to {str(path)!r}")
    return path


def open_below(root: Path, name: str) -> IO[bytes]:
    """Open a regular file below a root to read; OSError where there is none, or it cannot be opened."""
    return os.fdopen(open_regular(below(root, name), os.O_RDONLY | os.O_NOFOLLOW), "rb")


def name_below(root: Path, path: Path) -> str | None:
    """Return the name of a path below a root, or None where it is elsewhere."""
    whole = Path(os.path.realpath(path))
    if not whole.is_relative_to(root):
        return None
    name = whole.relative_to(root).as_posix()
    return "" if name == "." else name
