"""A folder of images as a traverse: its frames in order, and their features.

A frame is a file that OpenCV can decode, whatever its name, or one that by its extension should be: so that a damaged
image keeps its number, and what is known of the frames after it (a truth file) stays right. Hidden files and folders
in the folder do not count.
"""

from __future__ import annotations

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

from services.experiments.matching.image_reading import is_named_as_image, quiet_opencv, read_color, read_depth
from services.kit.errors import JobError, UsageError
from smal.evaluation.ground_truth import IntervalTruth
from smal.evaluation.truth_file import TruthFileError, read_truth
from smal.features import FeatureSettings, extract

#: Names that are spelled out when files are skipped.
NAMED: Final = 10
#: Each holds one decoded image, 300 MB of the largest that OpenCV is allowed to decode.
_WORKERS: Final = min(4, os.cpu_count() or 1)


@dataclass(frozen=True)
class ImageFolder:
    """The frames of a folder in natural order, a frame's number is its place; and files that are no images."""

    path: Path
    frames: tuple[str, ...]
    others: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class DescribedFrames:
    """The features of the frames that could be read.

    Parameters
    ----------
    features : float32 array (n, m)
        Raw features of `extract`.
    numbers : int64 array (n,)
        Which frame of the folder each row describes, ascending.
    unreadable : tuple of str
        Names of the others.
    """

    features: NDArray[np.float32]
    numbers: NDArray[np.int64]
    unreadable: tuple[str, ...]


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return what file names are sorted by: numbers in them by their value, letters whatever their case.

    Names that differ only in case or in leading zeros follow in the order of their characters.
    """
    # split with a group alternates text and digits, so that keys compare text with text and number with number.
    parts = re.split(r"([0-9]+)", name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name


def list_folder(path: Path, argument: str) -> ImageFolder:
    """Find the frames of a folder, which the argument of the command line names.

    Raises
    ------
    UsageError
        When there is no such folder, or nothing in it is an image.
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
        is_frame = [is_named_as_image(name) or read_color(path / name) is not None for name in names]
    frames = tuple(name for name, is_one in zip(names, is_frame, strict=True) if is_one)
    others = tuple(name for name, is_one in zip(names, is_frame, strict=True) if not is_one)
    if not frames:
        raise UsageError(f"{argument} {path}: no image in this folder (files: {len(others)})")
    return ImageFolder(path, frames, others)


def read_truth_of(path: Path, queries: ImageFolder, references: ImageFolder) -> IntervalTruth:
    """Read ``--truth``.

    Raises
    ------
    UsageError
        When the file is no truth of these folders, or there is nothing to find.
    """
    try:
        truth = read_truth(path, len(queries.frames), len(references.frames))
    except TruthFileError as error:
        raise UsageError(f"--truth {error}") from None
    if not truth.findable.any():
        raise UsageError(f"--truth {path}: no query has a reference, so that there is nothing to find")
    return truth


def describe_frames(
    folder: ImageFolder,
    settings: FeatureSettings,
    depth: ImageFolder | None,
    title: str,
) -> DescribedFrames:
    """Compute the features of the frames, with a progress bar of this title.

    Where the features need them, there are as many depth images in the same order.

    Raises
    ------
    JobError
        When no frame can be read, a feature cannot be computed, or the features do not fit into memory.
    """
    count = len(folder.frames)
    try:
        features = np.zeros((count, settings.size), dtype=np.float32)
    except MemoryError:
        raise JobError(f"{folder.path}: the features of {count} frames do not fit into memory") from None
    numbers: list[int] = []
    unreadable: list[str] = []
    with quiet_opencv(), ThreadPoolExecutor(_WORKERS) as pool:
        described = pool.map(partial(_describe, folder, settings, depth), range(count))
        bar = tqdm(described, desc=title, total=count, unit="image", dynamic_ncols=True, disable=None)
        for number, one in enumerate(bar):
            if one is None:
                unreadable.append(folder.frames[number])
            else:
                features[len(numbers)] = one
                numbers.append(number)
    if not numbers:
        raise JobError(_nothing_readable(folder, depth, unreadable))
    return DescribedFrames(features[: len(numbers)], np.array(numbers, np.int64), tuple(unreadable))


def _nothing_readable(folder: ImageFolder, depth: ImageFolder | None, names: list[str]) -> str:
    """Say whose fault it is that no frame can be described."""
    with quiet_opencv():
        if depth is not None and any(read_color(folder.path / name) is not None for name in names):
            return f"{depth.path}: none of {len(depth.frames)} images is depth: one channel of 16 bits"
    return f"{folder.path}: no image can be read: {_named(names)}"


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


def say_skipped(folder: ImageFolder, described: DescribedFrames) -> None:
    """Name on standard error what of a folder was skipped."""
    for names, one, many in (
        (folder.others, "1 file that is no image", "files that are no images"),
        (described.unreadable, "1 unreadable image, kept in the count of frames",
         "unreadable images, kept in the count of frames"),
    ):  # fmt: skip
        if names:
            what = one if len(names) == 1 else f"{len(names)} {many}"
            sys.stderr.write(f"smal: {folder.path}: skipped {what}: {_named(names)}\n")


def _named(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(map(printable, names[:NAMED])) + more


def printable(name: str) -> str:
    """Return a file's name with nothing in it that moves a terminal, or that UTF-8 cannot hold."""
    return "".join(c if c.isprintable() else "?" for c in name)
