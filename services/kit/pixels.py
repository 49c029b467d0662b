"""Pixels of image files of any format, and of raw images of ROS, as 8-bit RGB that stands upright."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import MOST_PIXELS

Pixels = NDArray[np.uint8]  # RGB, (height, width, 3).
#: Formats by the first bytes of a file, for reports. OpenCV reads further formats.
FORMATS: Final = {
    b"\xff\xd8": "JPEG", b"\x89PNG": "PNG", b"RIFF": "WebP", b"BM": "BMP", b"GIF8": "GIF",
    b"II*\0": "TIFF", b"MM\0*": "TIFF", b"P5": "PGM", b"P6": "PPM",
}  # fmt: skip
_BRAND: Final = 8  # Position of the format's name in a file of ISO media, such as HEIC and AVIF.
_BAYER: Final = ("RGGB", "BGGR", "GBRG", "GRBG")
#: EXIF data of a JPEG stand in the first of its segments, which have at most 64 kB each.
_EXIF_WITHIN: Final = 2**17


class _Layout(NamedTuple):
    """Numbers of a pixel, their bits, the conversion to RGB, and rows of data per row of pixels."""

    channels: int
    bits: int
    to_rgb: int | None
    rows: float = 1.0


def _encodings() -> dict[str, _Layout]:
    found = {
        "yuv422": _Layout(2, 8, cv2.COLOR_YUV2RGB_UYVY),
        "uyvy": _Layout(2, 8, cv2.COLOR_YUV2RGB_UYVY),
        "yuv422_yuy2": _Layout(2, 8, cv2.COLOR_YUV2RGB_YUY2),
        "yuyv": _Layout(2, 8, cv2.COLOR_YUV2RGB_YUY2),
        "nv12": _Layout(1, 8, cv2.COLOR_YUV2RGB_NV12, 1.5),
        "nv21": _Layout(1, 8, cv2.COLOR_YUV2RGB_NV21, 1.5),
        "i420": _Layout(1, 8, cv2.COLOR_YUV2RGB_I420, 1.5),
    }
    for bits in (8, 16):
        found |= {
            f"rgb{bits}": _Layout(3, bits, None),
            f"rgba{bits}": _Layout(4, bits, cv2.COLOR_RGBA2RGB),
            f"mono{bits}": _Layout(1, bits, cv2.COLOR_GRAY2RGB),
            f"{bits}UC1": _Layout(1, bits, cv2.COLOR_GRAY2RGB),
        }
        for name in (f"bgr{bits}", f"{bits}UC3"):
            found[name] = _Layout(3, bits, cv2.COLOR_BGR2RGB)
        for name in (f"bgra{bits}", f"{bits}UC4"):
            found[name] = _Layout(4, bits, cv2.COLOR_BGRA2RGB)
        for order in _BAYER:
            to_rgb = getattr(cv2, f"COLOR_Bayer{order}2RGB")
            found[f"bayer_{order.lower()}{bits}"] = _Layout(1, bits, to_rgb)
    return found


#: Encodings of `sensor_msgs/msg/Image`.
ENCODINGS: Final = _encodings()
_SUPPORTED: Final = (
    "rgb, bgr, rgba, bgra, mono and Bayer of 8 or 16 bits, yuv422, uyvy, yuyv, nv12, nv21, i420"
)


def format_of(data: bytes) -> str:
    """Return the name of an image file's format, or "other"."""
    if data[4:_BRAND] == b"ftyp":
        return data[_BRAND : _BRAND + 4].decode("ascii", errors="replace").upper()
    return next((name for start, name in FORMATS.items() if data.startswith(start)), "other")


@dataclass
class BitDepth:
    """Number of bits of a camera's values, by its largest value: 8, 10, 12, 14 or 16.

    Sensors of 10 to 14 bits fill 16 from below. One camera has one depth, or else its brightness
    depends on the brightest pixel of each image.
    """

    bits: int = 8

    def eight_bits(self, deep: NDArray[np.uint16]) -> Pixels:
        """Return the upper 8 bits of an image."""
        bits = 2 * -(-int(deep.max(initial=0)).bit_length() // 2)
        self.bits = max(self.bits, bits)
        return np.asarray(deep >> (self.bits - 8), dtype=np.uint8)


def rgb_of(
    image: Any,  # noqa: ANN401 - its class is made of its definition
    depth: BitDepth | None = None,
) -> Pixels:
    """Return the pixels of a `sensor_msgs/msg/Image`; ValueError if it is invalid."""
    layout = ENCODINGS.get(image.encoding)
    if layout is None:
        raise ValueError(
            f"unsupported encoding {image.encoding[:30]!r}; supported are {_SUPPORTED}"
        )
    width = image.width
    height = image.height
    rows = int(height * layout.rows)
    wide = width * layout.channels * layout.bits // 8
    if not (
        0 < width * height <= MOST_PIXELS
        and image.step >= wide
        and image.data.size == image.step * rows
    ):
        raise ValueError(
            f"invalid image: {width}x{height} pixels in {image.data.size} bytes, {image.step} per row"
        )
    planar = layout.rows > 1.0
    if (width % 2 and (layout.channels == 2 or planar)) or (height % 2 and planar):
        raise ValueError(f"invalid size {width}x{height}: {image.encoding} needs even numbers")
    packed = np.ascontiguousarray(image.data.reshape(rows, image.step)[:, :wide])
    if layout.bits == 16:
        packed = (depth or BitDepth()).eight_bits(
            packed.view(">u2" if image.is_bigendian else "<u2")
        )
    pixels = packed.reshape(rows, width, layout.channels)
    return pixels if layout.to_rgb is None else np.asarray(cv2.cvtColor(pixels, layout.to_rgb))


def decode_file(data: bytes, depth: BitDepth | None = None) -> Pixels | None:
    """Return the pixels of an image file, upright by its EXIF orientation; None if unreadable."""
    bgr = decoded(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if bgr is not None and bgr.dtype == np.uint16:
        bgr = (depth or BitDepth()).eight_bits(bgr)
    elif bgr is not None and bgr.dtype != np.uint8:
        bgr = decoded(data, cv2.IMREAD_COLOR)
    if bgr is None or bgr.dtype != np.uint8:
        return None
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def decoded(data: bytes, flags: int) -> NDArray[Any] | None:
    """Return an image file as OpenCV decodes it with these flags; None if it cannot."""
    # libpng reports a PNG without an end on standard error.
    if data.startswith(b"\x89PNG") and b"IEND" not in data:
        return None
    try:
        # From memory: for a truncated file cv2.imread returns a half grey image, cv2.imdecode None.
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (MemoryError, cv2.error):
        return None


def is_upright(jpeg: bytes) -> bool:
    """Return whether the EXIF orientation of a JPEG, if any, leaves its pixels as they are."""
    if b"Exif\0\0" not in jpeg[:_EXIF_WITHIN]:
        return True
    stored = decoded(jpeg, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    shown = decoded(jpeg, cv2.IMREAD_COLOR)
    return stored is None or shown is None or np.array_equal(stored, shown)
