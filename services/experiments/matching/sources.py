"""Frames of a traverse in order, from a folder of images, a video, or a recording of SMAL.

A frame of a folder is a file that OpenCV decodes, or a file with the extension of an image. So a
damaged image keeps its number, and a truth file stays valid for the frames after it. Hidden files
and subfolders are ignored.

Grey becomes three equal channels, the upper 8 of 10 to 16 bits remain, transparency is dropped.
Images are turned upright by their EXIF orientation.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.topics import JPEG
from services.experiments.words import remark
from services.kit.errors import JobError, UsageError
from services.kit.pixels import decode_file, decoded
from services.recordings.encoding import stamped_jpeg
from services.recordings.reader import read_recording

# Set before OpenCV opens its first video; FFmpeg writes long reports on damaged videos.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# Smallest size for `extract`.
LEAST_ROWS = 24
LEAST_COLUMNS = 32
MOST_BYTES: Final = 256 * 2**20  # Larger files are no camera images and are not read.
Picture = Path | bytes  # Path or content of a file.


@dataclass(frozen=True)
class TraverseSource:
    """Frame names in order, ignored files, and a function that returns the pictures anew."""

    path: Path
    frames: tuple[str, ...]
    others: tuple[str, ...]
    pictures: Callable[[], Iterable[Picture]]

    def images(self, numbers: Iterable[int]) -> dict[int, NDArray[np.uint8]]:
        """Return the readable images, RGB, of some frames."""
        wanted = set(numbers)
        with quiet_opencv():
            read = {
                number: read_color(one)
                for number, one in enumerate(self.pictures())
                if number in wanted
            }
        return {number: image for number, image in read.items() if image is not None}


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key: numbers by value, letters without case, then all characters."""
    # With a group, split alternates text and digits, so keys compare text with text and numbers
    # with numbers.
    parts = re.split(r"([0-9]+)", name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name


def open_source(path: Path, argument: str) -> TraverseSource:
    """Find the frames of an argument; raise UsageError if there are none."""
    if not path.is_file():
        return _folder(path, argument)
    return _recording(path) if path.suffix == ".mcap" else _video(path, argument)


def _folder(path: Path, argument: str) -> TraverseSource:
    try:
        with os.scandir(path) as entries:
            names = sorted((one.name for one in entries if _may_be_frame(one)), key=natural_key)
    except OSError as error:
        raise UsageError(f"{argument} {path}: {error.strerror}") from None
    with quiet_opencv():
        known = {
            name: path / name
            for name in names
            if is_named_as_image(name) or read_color(path / name) is not None
        }
    if not known:
        raise UsageError(f"{argument} {path}: no image in this folder (files: {len(names)})")
    others = tuple(name for name in names if name not in known)
    return TraverseSource(path, tuple(known), others, known.values)


def _may_be_frame(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a file or a broken link; a pipe can block forever."""
    if entry.name.startswith(".") or entry.is_dir():
        return False
    return entry.is_file() or entry.is_symlink()


def _recording(path: Path) -> TraverseSource:
    recording = read_recording(path, topics=[JPEG])
    remark(recording.remarks())
    frames = [
        (one.episode, tick, one.images[tick])
        for one in recording.episodes
        for tick in sorted(one.images)
    ]
    names = tuple(f"{episode} frame {tick}" for episode, tick, _ in frames)
    return TraverseSource(path, names, (), lambda: (_jpeg(payload) for _, _, payload in frames))


def _jpeg(payload: memoryview) -> bytes:
    try:
        return stamped_jpeg(bytes(payload))[1]
    except ValueError:
        return b""


def _video(path: Path, argument: str) -> TraverseSource:
    """Find the frames of a video by decoding it once, because the announced number is often wrong."""
    with quiet_opencv():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    times_s = []
    while video.grab():
        times_s.append(video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
    if not times_s:
        neither = "neither a folder of images, nor a recording, nor a readable video"
        raise JobError(f"{argument} {path}: {neither}")
    if len(times_s) < (said := int(video.get(cv2.CAP_PROP_FRAME_COUNT))):
        remark([f"{path}: only {len(times_s)} of {said} announced frames are readable"])
    return TraverseSource(
        path, tuple(f"{time_s:.3f} s" for time_s in times_s), (), partial(_bitmaps, path)
    )


def _bitmaps(path: Path) -> Iterator[bytes]:
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    while (read := video.read())[0]:
        yield cv2.imencode(".bmp", read[1])[1].tobytes()


def is_named_as_image(name: str) -> bool:
    """Return whether OpenCV supports the extension of a file."""
    suffix = Path(name).suffix
    try:
        return suffix.isascii() and len(suffix) > 1 and cv2.haveImageWriter(f"x{suffix}")
    except cv2.error:  # A format that OpenCV has disabled, such as .exr.
        return True


def loaded(picture: Picture) -> bytes | None:
    """Return the content of a file; None if it is unreadable or too large."""
    if isinstance(picture, bytes):
        return picture
    try:
        return picture.read_bytes() if picture.stat().st_size <= MOST_BYTES else None
    except (OSError, MemoryError):
        return None


def read_color(picture: Picture) -> NDArray[np.uint8] | None:
    """Return an image as RGB (height, width, 3), at least 24 rows and 32 columns; None if unreadable."""
    data = loaded(picture)
    rgb = None if data is None else decode_file(data)
    if rgb is None:
        return None
    height, width = rgb.shape[:2]
    if height >= LEAST_ROWS and width >= LEAST_COLUMNS:
        return rgb
    size = max(width, LEAST_COLUMNS), max(height, LEAST_ROWS)
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def read_depth(picture: Picture) -> NDArray[np.uint16] | None:
    """Return a depth image, uint16 (height, width) in millimetres; None if unreadable."""
    data = loaded(picture)
    depth_mm = None if data is None else decoded(data, cv2.IMREAD_UNCHANGED)
    if depth_mm is None or depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
        return None
    return np.asarray(depth_mm, dtype=np.uint16)


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV about damaged files, which this module reports."""
    logging = cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)
