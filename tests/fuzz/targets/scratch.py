"""Where the decoders of files find their file."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path


@cache
def folder() -> Path:
    """Return a folder of this process's own, gone with the process."""
    made = Path(tempfile.mkdtemp(prefix="smal-fuzz-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def file_of(data: bytes, name: str) -> Path:
    """Write an input to a file."""
    path = folder() / name
    path.write_bytes(data)
    return path
