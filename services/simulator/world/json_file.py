"""Read a world's JSON file within bounds: of bytes, of nesting, of how many things it holds."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, NoReturn

from schemas.codec import printable
from services.simulator.world.place import WorldError

if TYPE_CHECKING:
    from pathlib import Path

#: Bytes; a map of 5 MB becomes a world of about 1 MB.
LARGEST_FILE: Final = 32 * 1024 * 1024
# Counted before parsing: an empty list takes three bytes of the file and sixty of memory.
_MOST_OF: Final = {b"[": 1_500_000, b"{": 500_000, b",": 5_000_000}


def read_json(path: Path) -> dict[str, object]:
    """Return the object that a JSON file holds.

    Raises
    ------
    WorldError
        The file cannot be read, is too large, is no JSON, or holds something else than an object.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise WorldError(f"{path}: {size / 1e6:.0f} MB; a world has at most {LARGEST_FILE / 1e6:.0f} MB")
        data = path.read_bytes()
    except OSError as error:
        raise WorldError(f"{path}: {error.strerror}") from error
    for mark, most in _MOST_OF.items():
        if data.count(mark) > most:
            raise WorldError(f"{path}: more than {most:,} of '{mark.decode()}'; no world has so much in it")
    try:
        content = json.loads(data, parse_constant=_refuse)
    except RecursionError:
        raise WorldError(f"{path}: not a readable world file (nested too deeply)") from None
    except ValueError as error:
        raise WorldError(f"{path}: not a readable world file ({printable(str(error))})") from None
    if not isinstance(content, dict):
        raise WorldError(f"{path}: not a world file (holds no JSON object)")
    return content


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")
