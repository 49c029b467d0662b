"""Images of other people's files as JPEG: what is JPEG already stays as it is, to the byte."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.compressed_image import CompressedImage
from services.importers.drive import NotAnImage
from services.kit.jpeg import MOST_PIXELS, decode_image_file, decode_jpeg, encode_jpeg

#: Most bytes of an image file.
MOST_BYTES: Final = CompressedImage.max_bytes - 2**16
#: Columns and rows that a recording's image can have, and that features need.
_MOST: Final = (4096, 3072)
_LEAST: Final = (32, 24)
_JPEG: Final = b"\xff\xd8"
_PNG: Final = b"\x89PNG\r\n\x1a\n"


def as_jpeg(data: bytes) -> bytes:
    """Return an image file as JPEG.

    It is decoded in any case: half an image is found here, where it is counted, and not in learning.

    Raises
    ------
    NotAnImage
        When it is neither JPEG nor PNG, is damaged, or has a size that no camera has.
    """
    if len(data) > MOST_BYTES:
        raise NotAnImage("images are larger than 16 MiB")
    if data.startswith(_JPEG):
        try:
            check_size(decode_jpeg(data))
        except ValueError as error:
            raise error if isinstance(error, NotAnImage) else NotAnImage("images are damaged") from None
        return data
    if data.startswith(_PNG):
        return encode_jpeg(_decoded_png(data))
    raise NotAnImage("images are neither JPEG nor PNG")


def raw_as_jpeg(image: NDArray[np.uint8]) -> bytes:
    """Compress RGB pixels (height, width, 3).

    Raises
    ------
    NotAnImage
        When they have a size that no camera has.
    """
    check_size(image)
    return encode_jpeg(image)


def size_of(jpeg: bytes) -> tuple[int, int]:
    """Return width and height of what `as_jpeg` returned."""
    height, width, _ = decode_jpeg(jpeg).shape
    return width, height


def check_size(image: NDArray[np.uint8]) -> None:
    """Refuse, as `NotAnImage`, what is too large for a recording or too small for features."""
    height, width = image.shape[:2]
    if not (_LEAST[0] <= width <= _MOST[0] and _LEAST[1] <= height <= _MOST[1]):
        raise NotAnImage("images are not within 32x24 and 4096x3072 pixels")


def _decoded_png(data: bytes) -> NDArray[np.uint8]:
    # Before OpenCV, which makes room for what the header claims; and a PNG without an end makes libpng write of it.
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data[12:16] != b"IHDR" or not 0 < width * height <= MOST_PIXELS or b"IEND" not in data[-16:]:
        raise NotAnImage("images are damaged")
    image = decode_image_file(data)
    if image is None:
        raise NotAnImage("images are damaged")
    check_size(image)
    return image
