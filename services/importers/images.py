"""Conversion of foreign images to JPEG; upright JPEG files are copied unchanged."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.camera import CompressedImage
from schemas.codec import printable
from services.importers.clocks import in_order
from services.importers.drive import (
    Array,
    Image,
    Images,
    ImportedDrive,
    ImportFailure,
    NotAnImage,
    Tally,
)
from services.importers.inside import Inside
from services.kit.jpeg import decode_jpeg, encode_jpeg, jpeg_size, shrunk
from services.kit.pixels import ENCODINGS, BitDepth, decode_file, format_of, is_upright, rgb_of

MOST_BYTES: Final = CompressedImage.max_bytes - 2**16  # Maximum size of an image file, bytes.
_MOST: Final = (4096, 3072)  # Maximum columns and rows of a recorded image.
_LEAST: Final = (32, 24)  # Minimum columns and rows for features.
#: Maximum rate of robot cameras: higher rates are the times of copying the data set.
_FASTEST_HZ: Final = 120.0
_UNREAD: Final = "images cannot be read"
_CONVERTED: Final = "images of the format {} are converted to JPEG"
_PNG: Final = b"\x89PNG"
_DEPTH_HEADER: Final = 12  # Bytes before the PNG of a depth image that ROS compressed.


def as_jpeg(data: bytes, tally: Tally, depth: BitDepth, announced: str = "") -> bytes:
    """Return an image file as an upright JPEG; raises `NotAnImage` if it does not decode.

    The source can announce a format; the content decides.
    """
    if len(data) > MOST_BYTES:
        raise NotAnImage("images are larger than 16 MiB")
    form = format_of(data)
    pixels = decode_file(data, depth)
    if pixels is None:
        named = printable(announced[:60] or form)
        raise NotAnImage(
            f"images ({named}) are damaged, or OpenCV cannot decode them; convert them to JPEG"
        )
    if form != "JPEG":
        tally.count(_CONVERTED.format(form))
    elif not is_upright(data):
        tally.count("images are turned upright by their EXIF orientation")
    elif jpeg_size(data) is None:
        tally.count("images are JPEG of a rare form, encoded again")
    elif _recorded_width(pixels) == pixels.shape[1]:
        return data
    return raw_as_jpeg(pixels)


def ros_as_jpeg(
    image: Any,  # noqa: ANN401 - its class is made of its definition
    tally: Tally,
    depth: BitDepth,
) -> bytes:
    """Return a `CompressedImage` or an `Image` of ROS as JPEG; raises `NotAnImage` if invalid."""
    if hasattr(image, "format"):
        data = bytes(image.data)
        if data.startswith(_PNG, _DEPTH_HEADER):
            tally.say("images show depth (compressedDepth); choose the colour images with --camera")
            data = data[_DEPTH_HEADER:]
        return as_jpeg(data, tally, depth, image.format)
    if image.encoding not in ENCODINGS:
        raise NotAnImage(f"images have the unsupported encoding {image.encoding or '(empty)'}")
    try:
        pixels = rgb_of(image, depth)
    except ValueError:
        raise NotAnImage("images are damaged, or their size does not fit their encoding") from None
    tally.count(_CONVERTED.format(image.encoding))
    return raw_as_jpeg(pixels)


def raw_as_jpeg(pixels: NDArray[np.uint8]) -> bytes:
    """Compress RGB pixels (height, width, 3), shrunk to the largest recorded size."""
    width = _recorded_width(pixels)
    return encode_jpeg(pixels if width == pixels.shape[1] else shrunk(pixels, width))


def _recorded_width(pixels: NDArray[np.uint8]) -> int:
    """Return the width of a recorded image; raises `NotAnImage` if it is too small."""
    height, width = pixels.shape[:2]
    recorded = int(min(width, _MOST[0], _MOST[1] * width // height))
    if recorded < _LEAST[0] or height * recorded < _LEAST[1] * width:
        raise NotAnImage("images are smaller than 32x24 pixels")
    return recorded


def rotated(images: Images, clockwise_deg: int) -> Images:
    """Return images turned clockwise by a multiple of 90 degrees."""
    return lambda: (partial(_rotated, image, clockwise_deg) for image in images())


def _rotated(image: Image, clockwise_deg: int) -> bytes:
    return raw_as_jpeg(np.rot90(decode_jpeg(image()), -clockwise_deg // 90))


def aspect_of(images: Images) -> float | None:
    """Return height over width of the first usable image; None if no image is usable."""
    for image in images():
        with suppress(NotAnImage):
            if (size := jpeg_size(image())) is not None:
                return size[1] / size[0]
    return None


class Row(NamedTuple):
    """A frame: image file, time, velocity (speed ahead, turn rate), and pose by odometry."""

    image: str
    time_s: float
    velocity: tuple[float, float] | None
    pose: tuple[float, float, float] | None = None
    number: int = 0  # Position in the table.


Shown = Callable[[Sequence[Row]], tuple[Array, Images]]


def drive_of(
    inside: Inside,
    name: str,
    rows: Sequence[Row],
    tally: Tally,
    *,
    shown: Shown | None = None,
    **more: Any,  # noqa: ANN401
) -> ImportedDrive:
    """Create a drive from its frames; raise ImportFailure if the frame rate is implausible.

    The images are the files of the rows, or, with their times, those that ``shown`` returns.
    ``more`` are further fields of the drive.
    """
    rows = _distinct(rows, tally) if shown is None else rows
    times_s = in_order(np.array([row.time_s for row in rows]), tally)
    rows = [rows[at]._replace(time_s=times_s[at]) for at in np.argsort(times_s, kind="stable")]
    if shown is None:
        times_s = np.sort(times_s)
        images = files([row.image for row in rows], inside, tally)
    else:
        times_s, images = shown(rows)
    usual_s = float(np.median(np.diff(times_s))) if times_s.size > 1 else 1.0
    if usual_s * _FASTEST_HZ < 1.0:
        rate = f"{1.0 / usual_s:.0f} frames per second" if usual_s > 0.0 else "all frames at once"
        raise ImportFailure(
            f"{inside.path}: invalid times ({rate}), as in a copied data set; give the frame "
            "rate with --rate, for example --rate 20"
        )
    motion = [(row.time_s, *row.velocity) for row in rows if row.velocity is not None]
    track = [(row.time_s, *row.pose) for row in rows if row.pose is not None]
    return ImportedDrive.of_rows(name, times_s, images, motion, track, tally, **more)


def _distinct(rows: Sequence[Row], tally: Tally) -> Sequence[Row]:
    distinct = {(row.image, row.time_s): row for row in rows}
    tally.count("rows are repeated (read once)", len(rows) - len(distinct))
    return list(distinct.values())


def files(names: Sequence[str], inside: Inside, tally: Tally) -> Images:
    """Return the image files of a folder as JPEG."""
    depth = BitDepth()
    return lambda: (partial(_image, inside, name, tally, depth) for name in names)


def _image(inside: Inside, name: str, tally: Tally, depth: BitDepth) -> bytes:
    try:
        return as_jpeg(inside.read(inside.spelled(name), MOST_BYTES), tally, depth)
    except ImportFailure as error:
        tally.say_first(_UNREAD, str(error))
        raise NotAnImage(_UNREAD) from None
