"""Where commands write their results: checked before the work begins, written whole or not at all."""

import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from services.kit.errors import JobError, UsageError
from smal.files.container import FULL, replacing


def make_folder(path: Path, option: str) -> None:
    """Make the folder for results before the work begins; UsageError when nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UsageError(f"{option} {path}: is a file, not a folder") from None
    except OSError as error:
        raise UsageError(f"{option} {path}: {error.strerror}") from None
    if not os.access(path, os.W_OK):
        raise UsageError(f"{option} {path}: cannot be written to")


def check_file(
    path: Path | None, option: str, read: Iterable[str | Path] = (), folders: Iterable[Path] = ()
) -> None:
    """Check before the work that a file of results can be written, apart from all that is read; else UsageError."""
    if path is None:
        return
    fault = _unwritable(path)
    if fault is None and path.exists() and any(map(path.samefile, filter(os.path.exists, read))):
        fault = "is a file that this command reads; give another name"
    if fault is None and path.resolve().parent in [folder.resolve() for folder in folders]:
        fault = "would lie among the files that this command reads; choose another folder"
    if fault is not None:
        raise UsageError(f"{option} {path}: {fault}")


def _unwritable(path: Path) -> str | None:
    if path.is_dir():
        return "is a folder; give the name of a file"
    if path.exists() and not path.is_file():
        return "is no regular file, and would be replaced by one; give another name"
    if not path.parent.is_dir():
        return f"no folder {path.parent}"
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        return "cannot be written"
    return None


@contextmanager
def workshop(folder: Path, option: str) -> Iterator[Path]:
    """Make a folder, and one in it for results until all are whole; where that fails, a new folder is gone too."""
    new = not folder.exists()
    make_folder(folder, option)
    try:
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as made:
            yield Path(made)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in FULL:
            error.filename = str(folder)  # Not that of a file which is gone.
        if new:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def new_folder(path: Path, option: str) -> Iterator[Path]:
    """Fill a new or empty folder, which gets its name when it is whole; UsageError when there is something else."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UsageError(
            f"{option} {path}: exists{' and is not empty' if path.is_dir() else ''}; give another name"
        )
    place = path.resolve()
    with workshop(place.parent, option) as shop:
        (shop / place.name).mkdir()
        yield shop / place.name
        (shop / place.name).rename(place)


@contextmanager
def writing(path: Path, option: str) -> Iterator[IO[bytes]]:
    """Write a file so that there is never a half-written one; raises JobError when the system refuses."""
    try:
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise JobError(f"{option} {path}: cannot be written: {error.strerror or error}") from None


def write_json(path: Path, option: str, content: object) -> None:
    """Write results as JSON, as `writing` does."""
    with writing(path, option) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())
