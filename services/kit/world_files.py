"""Files that become a world: maps of OpenStreetMap and scans, with the largest size of each."""

from pathlib import Path
from typing import Final

#: Maximum bytes of a map; a town of several thousand buildings takes a third.
LARGEST_MAP: Final = 64 << 20
#: Maximum bytes of an uploaded scan: the link uploads it within minutes.
LARGEST_SCAN: Final = 128 << 20
_SCANS: Final = ("glb", "gltf", "obj", "ply")
# First bytes of the formats that hold everything in one file.
_MARKS: Final = {b"glTF": "glb", b"ply\n": "ply", b"ply\r": "ply"}
HEAD_BYTES: Final = 4  # Length of these marks.


def scan_format(source: Path) -> str | None:
    """Return the format of a scan, by its suffix or else by its first bytes; None for a map."""
    if source.suffix:
        name = source.suffix.lower()[1:]
        return name if name in _SCANS else None
    with source.open("rb") as file:
        return _MARKS.get(file.read(HEAD_BYTES))


def largest_upload(head: bytes) -> tuple[str, int]:
    """Return the kind of an upload by its first bytes, and the maximum bytes of that kind."""
    is_scan = head[:HEAD_BYTES] in _MARKS
    return ("scan", LARGEST_SCAN) if is_scan else ("map", LARGEST_MAP)
