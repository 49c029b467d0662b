"""Drives to replay, and a model that knows their place: given, or made here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from services.cli.options import Camera
from services.kit.errors import JobError
from services.recordings.dataset import find_recordings
from services.recordings.encoding import decode_image
from services.recordings.reader import RecordingError, read_recording
from tests.benchmarks.drives import demonstrate, learn

Frames = list[NDArray[np.uint8]]
#: Pose of each frame by the wheels: x, y in metres, heading in radians.
Way = list[tuple[float, float, float]]


def make(folder: Path, episodes: int, recoveries: int) -> Path:
    """Drive on the campus, and learn from it; the progress of both goes to standard error.

    Returns
    -------
    Path
        The model, in the folder of the drives.
    """
    demonstrate(folder, episodes, recoveries)
    return learn(folder)


def drives(folder: Path) -> Iterator[tuple[Frames, Way]]:
    """Give the camera images of one whole drive after the other, (height, width, 3), and its way, over and over.

    Raises
    ------
    JobError
        There is none.
    """
    paths = find_recordings([folder])
    found = True
    while found:
        found = False
        for path in paths:
            for drive in _drives_of(path):
                found = True
                yield drive
    raise JobError(f"{folder}: holds no drive with camera images and odometry")


def _drives_of(path: Path) -> Iterator[tuple[Frames, Way]]:
    try:
        episodes = read_recording(path).episodes
    except RecordingError as error:
        raise JobError(str(error)) from None
    for episode in episodes:
        ticks = sorted(episode.images.keys() & episode.odometry.keys())
        if episode.purpose != "recovery" and ticks:
            images = [decode_image(bytes(episode.images[tick])) for tick in ticks]
            yield images, [episode.odometry[tick] for tick in ticks]


def resized(frames: Frames, camera: Camera | None) -> Frames:
    """Bring images to the size of another camera; None leaves them as they are."""
    if camera is None or frames[0].shape[:2] == (camera.height, camera.width):
        return frames
    size = (camera.width, camera.height)
    return [np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_CUBIC), np.uint8) for one in frames]
