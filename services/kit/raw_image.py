"""Pixels as ROS 2 sends them, ``sensor_msgs/Image``."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import MOST_PIXELS

#: Bytes of the largest that is taken: as many pixels as a camera has, of three bytes each, and what stands beside them.
LARGEST_BYTES: Final = 3 * MOST_PIXELS + 4096
#: Bytes of a pixel, and how it becomes RGB, by the encoding's name.
ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB), "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB), "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}  # fmt: skip


def rgb_of(encoding: str, width: int, height: int, step: int, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the RGB pixels (height, width, 3) of rows of ``step`` bytes; ValueError when that does not fit."""
    if encoding not in ENCODINGS:
        raise ValueError(f"encoding {encoding[:30]!r}: known are {', '.join(ENCODINGS)}")
    size, conversion = ENCODINGS[encoding]
    if not (0 < width * height <= MOST_PIXELS and step >= width * size and data.size == step * height):
        raise ValueError(f"{width}x{height} pixels in {data.size} bytes, {step} a row: that cannot be")
    if size == 2 and width % 2:
        raise ValueError(f"{width} columns: pixels of {encoding} come in pairs")
    pixels = np.ascontiguousarray(data.reshape(height, step)[:, : width * size]).reshape(height, width, size)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
