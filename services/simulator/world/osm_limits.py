"""What an OpenStreetMap file may cost, checked before and while it is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from services.simulator.world.place import WorldError

if TYPE_CHECKING:
    from pathlib import Path

#: Bytes; a town of several thousand buildings has a third of it.
LARGEST_FILE: Final = 64 * 1024 * 1024
#: Points of all ways and relations together, and tagged nodes, ways and relations.
MOST_POINTS: Final = 1_000_000
MOST_ELEMENTS: Final = 200_000
#: OpenStreetMap's own limits; only a file made by hand has longer ones.
MOST_POINTS_OF_A_WAY: Final = 2_000
LONGEST_TAG: Final = 255
#: A larger world would take more memory than a machine has: roads become points a couple of metres apart.
LARGEST_M: Final = 10_000.0
#: Of roads, barriers and waterways.
MOST_WAY_M: Final = 500_000.0

_CHUNK: Final = 1 << 20
# What may begin a definition; two chunks overlap by the longest.
_FORBIDDEN: Final = (b"<!DOCTYPE", b"<!ENTITY")
# Text in UTF-16 or UTF-32, where the words above would not be found, is full of zero bytes.
_ZERO: Final = b"\0"


def check_file(path: Path) -> None:
    """Refuse a file that is too large, or that defines entities, before a parser sees it.

    Raises
    ------
    WorldError
        The file cannot be read, has more than 64 MB, or holds a document type or an entity.
    OSError
        The file cannot be read.
    """
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise WorldError(f"{path}: {size / 1e6:.0f} MB; a map has at most {LARGEST_FILE / 1e6:.0f} MB, cut it smaller")
    with path.open("rb") as file:
        tail = b""
        while chunk := file.read(_CHUNK):
            _check_chunk(path, tail + chunk)
            tail = chunk[-len(_FORBIDDEN[0]) :]


def _check_chunk(path: Path, chunk: bytes) -> None:
    if _ZERO in chunk:
        raise WorldError(f"{path}: not a readable OpenStreetMap XML file (holds zero bytes; it must be UTF-8)")
    for word in _FORBIDDEN:
        if word in chunk:
            raise WorldError(f"{path}: holds {word.decode()}; a map defines no document type and no entities")
