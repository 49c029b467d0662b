"""JPEG, the format of all colour images on the wire."""

from typing import Final, cast

import cv2
import numpy as np
from numpy.typing import NDArray

#: A frame of 1024x768 takes 200 kB, a twelfth of its pixels, and its features have a cosine of
#: 0.9998 with the features of the pixels; at 90 it takes 137 kB.
QUALITY: Final = 95
#: Maximum number of decoded pixels; a header can claim any number.
MOST_PIXELS: Final = 4096 * 3072
_FRAME_MARKERS: Final = (0xC0, 0xC1, 0xC2)
_TABLE_MARKERS: Final = (0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0))


def encode_jpeg(image: NDArray[np.uint8], quality: int = QUALITY) -> bytes:
    """Compress a (height, width, 3) RGB image; ValueError if it has too many pixels for JPEG."""
    done, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not done:
        height, width = image.shape[:2]
        raise ValueError(f"OpenCV cannot encode a {width}x{height} image as JPEG")
    return jpeg.tobytes()


def shrunk(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Resize a (height, width, 3) image to a width, with the same aspect ratio."""
    height = max(1, round(width * image.shape[0] / image.shape[1]))
    return cast(
        "NDArray[np.uint8]", cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    )


def decode_jpeg(data: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG to RGB pixels (height, width, 3); ValueError if it is invalid or too large."""
    # OpenCV allocates as many pixels as the header claims, up to 3 GB.
    if not is_jpeg(data):
        raise ValueError(f"invalid JPEG image, or too large (maximum {MOST_PIXELS} pixels)")
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        bgr = None
    if bgr is None:
        raise ValueError("invalid JPEG image")
    return cast("NDArray[np.uint8]", cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def is_jpeg(data: bytes) -> bool:
    """Return whether the data begin as a JPEG of a camera's size; reads the header only."""
    width, height = jpeg_size(data) or (0, 0)
    return 0 < width * height <= MOST_PIXELS


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in a JPEG's header, or None."""
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _FRAME_MARKERS:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(
                data[at + 5 : at + 7], "big"
            )
        # Tables and comments have a length; other segments before the frame do not occur in a
        # camera's JPEG.
        if marker not in _TABLE_MARKERS:
            return None
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
