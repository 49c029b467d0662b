"""What a traverse is read from, its frames in order: a folder of images, a video, or a recording of SMAL.

A frame of a folder is a file that OpenCV can decode, whatever its name, or one that by its extension should be: so that
a damaged image keeps its number, and what is known of the frames after it (a truth file) stays right. Hidden files and
folders in the folder do not count.

Colour is what OpenCV's IMREAD_COLOR makes of it: grey becomes three equal channels, of 16 bits the upper 8 are kept,
transparency is dropped. The orientation that a camera noted in EXIF is ignored in every file, for half of a traverse
may lack it.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.topics import JPEG
from services.experiments.words import remark
from services.kit.errors import UsageError
from services.recordings.encoding import stamped_jpeg
from services.recordings.reader import read_recording

# Read when OpenCV opens its first video; of a damaged one FFmpeg writes at length.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# The least size that `extract` takes.
LEAST_ROWS = 24
LEAST_COLUMNS = 32
MOST_BYTES: Final = 256 * 2**20  # A larger file is no camera's image; it is not read at all.
_PNG: Final = (
    b"\x89PNG\r\n\x1a\n",
    b"IEND",
)  # How a PNG file begins, and what every whole one ends with.
Picture = Path | bytes  # A file, or what stands in one.
_COLOR: Final = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


@dataclass(frozen=True)
class TraverseSource:
    """Names of frames, in order, and of files that are no images; a picture of each frame, anew with each call."""

    path: Path
    frames: tuple[str, ...]
    others: tuple[str, ...]
    pictures: Callable[[], Iterable[Picture]]

    def images(self, numbers: Iterable[int]) -> dict[int, NDArray[np.uint8]]:
        """Return the images, RGB, of those of some frames that can be read."""
        wanted = set(numbers)
        with quiet_opencv():
            read = {
                number: read_color(one)
                for number, one in enumerate(self.pictures())
                if number in wanted
            }
        return {number: image for number, image in read.items() if image is not None}


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return what names are sorted by: numbers by their value, letters whatever their case, then all characters."""
    # split with a group alternates text and digits, so that keys compare text with text and number with number.
    parts = re.split(r"([0-9]+)", name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name


def open_source(path: Path, argument: str) -> TraverseSource:
    """Find the frames that an argument names; UsageError when there is none, RecordingError of a bad recording."""
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
    """Return whether an entry is a file or a broken link, which was meant to be a frame; a pipe could block forever."""
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
    """Find the frames of a video by decoding it once: what it says of their number is often not so."""
    with quiet_opencv():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    times_s = []
    while video.grab():
        times_s.append(video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
    if not times_s:
        neither = "neither a folder of images, nor a recording, nor a video that OpenCV reads"
        raise UsageError(f"{argument} {path}: {neither}")
    if len(times_s) < (said := int(video.get(cv2.CAP_PROP_FRAME_COUNT))):
        remark(
            [f"{path}: only {len(times_s)} of the {said} frames that it should have can be read"]
        )
    return TraverseSource(
        path, tuple(f"{time_s:.3f} s" for time_s in times_s), (), partial(_bitmaps, path)
    )


def _bitmaps(path: Path) -> Iterator[bytes]:
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    while (read := video.read())[0]:
        yield cv2.imencode(".bmp", read[1])[1].tobytes()


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
        rgb = cv2.resize(
            rgb,
            (max(width, LEAST_COLUMNS), max(height, LEAST_ROWS)),
            interpolation=cv2.INTER_LINEAR,
        )
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
