"""Root folder of a service: callers on the bus reach only the files below it."""

import os
from pathlib import Path
from typing import IO, Annotated, Final

from pydantic import AfterValidator

from services.kit.settings import ServiceSettings
from smal.files.container import open_regular

#: Folder below the root for worlds made from maps: the console creates them, the simulator opens
#: them.
WORLDS: Final = "worlds"


def _folder(path: Path) -> Path:
    if not path.is_dir():
        raise ValueError(f"{path}: folder not found")
    return path.resolve()


class RootSettings(ServiceSettings):
    """Folder of the files that callers can name."""

    root: Annotated[Path, AfterValidator(_folder)] = Path()
    """Folder of the files that calls can name, by their path below it; the working directory by
    default.
    """


class OutsideError(OSError):
    """A name that leads out of the root by a link."""


def below(root: Path, name: str) -> Path:
    """Return the resolved path of a name below a resolved root.

    `schemas.rpc` has checked the name: relative, without a way up, and empty for the root itself.

    Raises
    ------
    OutsideError
        If a link leads out of the root.
    OSError
        If there is a loop of links.
    """
    path = Path(os.path.realpath(root / name))
    if not path.is_relative_to(root):
        raise OutsideError(f"leads out of {root}, to {str(path)!r}")
    return path


def open_below(root: Path, name: str) -> IO[bytes]:
    """Open a regular file below a root for reading; OSError if that is impossible."""
    return os.fdopen(open_regular(below(root, name), os.O_RDONLY | os.O_NOFOLLOW), "rb")


def name_below(root: Path, path: Path) -> str | None:
    """Return the name of a path below a root, or None for a path elsewhere."""
    whole = Path(os.path.realpath(path))
    if not whole.is_relative_to(root):
        return None
    name = whole.relative_to(root).as_posix()
    return "" if name == "." else name
