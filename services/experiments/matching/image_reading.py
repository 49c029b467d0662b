"""One image as an array, of a file of any format that OpenCV reads.

Colour is what OpenCV's IMREAD_COLOR makes of it: grey becomes three equal channels, of 16 bits the upper 8 are kept,
transparency is dropped. The orientation that a camera noted in EXIF is ignored in every file, for half of a traverse
may lack it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

LEAST_ROWS, LEAST_COLUMNS = 24, 32  # The least size that `extract` takes.
MOST_BYTES: Final = 256 * 2**20  # A larger file is no camera's image; it is not read at all.
_PNG: Final = (b"\x89PNG\r\n\x1a\n", b"IEND")  # How a PNG file begins, and what every whole one ends with.
Picture = Path | bytes  # A file, or what stands in one.
_COLOR: Final = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def is_named_as_image(name: str) -> bool:
    """Return whether a file's extension is that of a format that OpenCV knows."""
    suffix = Path(name).suffix
    try:
        return suffix.isascii() and len(suffix) > 1 and cv2.haveImageWriter(f"x{suffix}")
    except cv2.error:  # a format that OpenCV knows and has turned off, as .exr
        return True


def loaded(picture: Picture) -> bytes | None:
    """Return what stands in a file; None if it cannot be read, or is larger than a camera's."""
    if isinstance(picture, bytes):
        return picture
    try:
        return picture.read_bytes() if picture.stat().st_size <= MOST_BYTES else None
    except (OSError, MemoryError):
        return None


def read_color(picture: Picture) -> NDArray[np.uint8] | None:
    """Return an image as RGB (height, width, 3), at least 24 rows and 32 columns; None if it cannot be read."""
    bgr = _decoded(picture, _COLOR)
    if bgr is None or bgr.dtype != np.uint8:
        return None
    rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    height, width = rgb.shape[:2]
    if height < LEAST_ROWS or width < LEAST_COLUMNS:
        rgb = cv2.resize(rgb, (max(width, LEAST_COLUMNS), max(height, LEAST_ROWS)), interpolation=cv2.INTER_LINEAR)
    return np.asarray(rgb, dtype=np.uint8)


def read_depth(picture: Picture) -> NDArray[np.uint16] | None:
    """Return a depth image, uint16 (height, width) in millimetres; None if it is none or cannot be read."""
    depth_mm = _decoded(picture, cv2.IMREAD_UNCHANGED)
    if depth_mm is None or depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        return None
    return np.asarray(depth_mm, dtype=np.uint16)


def _decoded(picture: Picture, flags: int) -> NDArray[Any] | None:
    data = loaded(picture)
    # Of a PNG without an end libpng would write on standard error.
    if data is None or (data.startswith(_PNG[0]) and _PNG[1] not in data):
        return None
    try:
        # From memory: of a truncated file cv2.imread makes a half grey image, cv2.imdecode none.
        decoded: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (MemoryError, cv2.error):
        return None
    return decoded


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing of every damaged file at length; this module names them."""
    logging = cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)
