"""A folder of images as a traverse: its frames in order, and their features.

A frame is a file that OpenCV can decode, whatever its name, or one that by its extension should be: so that a damaged
image keeps its number, and what is known of the frames after it (a truth file) stays right. Hidden files and folders
in the folder do not count.
"""

import os
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from schemas.codec import printable
from services.experiments.matching.image_reading import is_named_as_image, quiet_opencv, read_color, read_depth
from services.experiments.words import listed
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings, extract

#: Each holds one decoded image, 300 MB of the largest that OpenCV is allowed to decode.
_WORKERS: Final = min(4, os.cpu_count() or 1)


@dataclass(frozen=True)
class ImageFolder:
    """The frames of a folder in natural order, a frame's number is its place; and files that are no images."""

    path: Path
    frames: tuple[str, ...]
    others: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Traverse:
    """A folder, and what of it is compared: raw features (n, m) of readable frames, and their numbers (n,)."""

    folder: ImageFolder
    features: NDArray[np.float32]
    numbers: NDArray[np.int64]

    @property
    def unreadable(self) -> list[str]:
        """Names of the frames that could not be read."""
        known = set(self.numbers.tolist())
        return [name for number, name in enumerate(self.folder.frames) if number not in known]

    def say_skipped(self) -> None:
        """Name on standard error what of the folder was skipped."""
        skipped = {"no images": self.folder.others, "unreadable, and kept in the count of frames": self.unreadable}
        for why, names in skipped.items():
            if names:
                sys.stderr.write(f"smal: {self.folder.path}: skipped {len(names)}, {why}: {_named(names)}\n")


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return what file names are sorted by: numbers in them by their value, letters whatever their case.

    Names that differ only in case or in leading zeros follow in the order of their characters.
    """
    # split with a group alternates text and digits, so that keys compare text with text and number with number.
    parts = re.split(r"([0-9]+)", name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name


def list_folder(path: Path, argument: str) -> ImageFolder:
    """Find the frames of a folder, which the argument of the command line names.

    Raises UsageError when there is no such folder, or nothing in it is an image.
    """
    try:
        with os.scandir(path) as entries:
            # What is neither a file nor a folder could be a pipe, which nobody ever writes to; a link to nothing was
            # meant to be a frame.
            files = [e for e in entries if not e.name.startswith(".") and (e.is_file() or e.is_symlink())]
            names = [e.name for e in files if not e.is_dir()]
    except NotADirectoryError:
        raise UsageError(f"{argument} {path}: is a file, not a folder of images") from None
    except OSError as error:
        raise UsageError(f"{argument} {path}: {error.strerror}") from None
    names.sort(key=natural_key)
    with quiet_opencv():
        frames = tuple(name for name in names if is_named_as_image(name) or read_color(path / name) is not None)
    if not frames:
        raise UsageError(f"{argument} {path}: no image in this folder (files: {len(names)})")
    known = set(frames)
    return ImageFolder(path, frames, tuple(name for name in names if name not in known))


def describe_frames(folder: ImageFolder, settings: FeatureSettings, depth: ImageFolder | None, title: str) -> Traverse:
    """Compute the features of the frames, with a progress bar of this title.

    Where the features need them, there are as many depth images in the same order.

    Raises JobError when no frame can be read, a feature cannot be computed, or the features do not fit into memory.
    """
    count = len(folder.frames)
    try:
        features = np.zeros((count, settings.size), dtype=np.float32)
    except MemoryError:
        raise JobError(f"{folder.path}: the features of {count} frames do not fit into memory") from None
    numbers: list[int] = []
    with quiet_opencv(), ThreadPoolExecutor(_WORKERS) as pool:
        described = pool.map(partial(_describe, folder, settings, depth), range(count))
        bar = tqdm(described, desc=title, total=count, unit="image", dynamic_ncols=True, disable=None)
        for number, one in enumerate(bar):
            if one is not None:
                features[len(numbers)] = one
                numbers.append(number)
    if not numbers:
        without = "" if depth is None else f" with a depth image, of one channel of 16 bits, in {depth.path}"
        raise JobError(f"{folder.path}: no image can be read{without}: {_named(folder.frames)}")
    return Traverse(folder, features[: len(numbers)], np.array(numbers, np.int64))


def _describe(
    folder: ImageFolder, settings: FeatureSettings, depth: ImageFolder | None, number: int
) -> NDArray[np.float32] | None:
    """Return the raw features of a frame; None for one that cannot be read."""
    path = folder.path / folder.frames[number]
    image = read_color(path)
    depth_mm = None if depth is None else read_depth(depth.path / depth.frames[number])
    if image is None or (depth is not None and depth_mm is None):
        return None
    try:
        return extract(image, settings, depth_mm)
    except ValueError as error:
        raise JobError(f"{path}: {error}") from None


def _named(names: Sequence[str]) -> str:
    return listed([printable(name, 255) for name in names])
