"""Pixels of ``sensor_msgs/Image``."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from services.importers.drive import NotAnImage
from services.kit.jpeg import MOST_PIXELS

#: Channels of each encoding, and how OpenCV makes RGB of it.
_ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}


def rgb_of(encoding: str, width: int, height: int, step: int, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return RGB pixels (height, width, 3).

    Raises
    ------
    NotAnImage
        When the encoding is none of eight bits and known here, or numbers and pixels do not fit.
    """
    if encoding not in _ENCODINGS:
        raise NotAnImage("images have an encoding that is not read (8 bits of RGB, BGR, grey or YUV 4:2:2 are)")
    channels, conversion = _ENCODINGS[encoding]
    if not (0 < width * height <= MOST_PIXELS and step >= width * channels and data.size == step * height):
        raise NotAnImage("images are damaged")
    pixels = np.ascontiguousarray(data.reshape(height, step)[:, : width * channels]).reshape(height, width, channels)
    if conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    except cv2.error:  # YUV 4:2:2 has an even number of columns
        raise NotAnImage("images are damaged") from None
