"""Files and folders of results: checked before the work and written completely or not at all."""

import json
import os
import sys
import tempfile
import webbrowser
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from services.kit.errors import JobError, UsageError
from smal.files.container import FULL, replacing


def make_folder(path: Path, option: str) -> None:
    """Create the folder for results before the work begins."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UsageError(f"{option} {path}: is a file, not a folder") from None
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror}") from None
    if not os.access(path, os.W_OK):
        raise UsageError(f"{option} {path}: permission denied")


def check_file(
    path: Path | None, option: str, read: Iterable[str | Path] = (), folders: Iterable[Path] = ()
) -> None:
    """Check before the work that a file of results can be written and differs from all input."""
    if path is None:
        return
    fault = _unwritable(path)
    if fault is None and path.exists() and any(map(path.samefile, filter(os.path.exists, read))):
        fault = "is an input of this command; choose another name"
    if fault is None and path.resolve().parent in [folder.resolve() for folder in folders]:
        fault = "is in an input folder of this command; choose another folder"
    if fault is not None:
        raise UsageError(f"{option} {path}: {fault}")


def _unwritable(path: Path) -> str | None:
    if path.is_dir():
        return "is a folder; choose a file name"
    if path.exists() and not path.is_file():
        return "is not a regular file; choose another name"
    if not path.parent.is_dir():
        return f"folder {path.parent} not found"
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        return "permission denied"
    return None


@contextmanager
def workshop(folder: Path, option: str) -> Iterator[Path]:
    """Create a folder, and a temporary folder in it for incomplete results; clean up after a failure."""
    new = not folder.exists()
    make_folder(folder, option)
    try:
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as made:
            yield Path(made)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in FULL:
            error.filename = str(folder)  # The temporary file has been deleted.
        if new:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def new_folder(path: Path, option: str) -> Iterator[Path]:
    """Fill a new or empty folder, which gets its name when it is complete."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UsageError(
            f"{option} {path}: already exists{' and is not empty' if path.is_dir() else ''}; "
            "choose another name"
        )
    place = path.resolve()
    with workshop(place.parent, option) as shop:
        (shop / place.name).mkdir()
        yield shop / place.name
        (shop / place.name).rename(place)


@contextmanager
def writing(path: Path, option: str) -> Iterator[IO[bytes]]:
    """Write a file atomically; raise JobError if that fails."""
    try:
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise JobError(f"{option} {path}: cannot be written: {error.strerror or error}") from None


def open_page(address: str) -> None:
    """Open a page in the browser; do nothing on a machine without a desktop."""
    if sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        webbrowser.open(address)


def write_json(path: Path, option: str, content: object) -> None:
    """Write results as JSON; see `writing`."""
    with writing(path, option) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())
