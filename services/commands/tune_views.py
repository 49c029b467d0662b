"""Features of some frames of a folder, as they were taken or under other conditions."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from services.commands.errors import JobError
from services.commands.image_folder import DescribedFrames, ImageFolder
from services.commands.image_reading import quiet_opencv, read_color
from smal.evaluation.other_conditions import Conditions
from smal.features import FeatureSettings, extract

_WORKERS: Final = min(4, os.cpu_count() or 1)


def describe_degraded(
    folder: ImageFolder,
    settings: FeatureSettings,
    frames: Sequence[int],
    conditions: Conditions | None,
    seed: int,
    title: str,
) -> DescribedFrames:
    """Compute the features of some frames, with a progress bar.

    Parameters
    ----------
    folder, settings
        Colour images, and the features.
    frames
        Numbers of the frames.
    conditions
        How they are degraded first; None for not at all.
    seed
        Of the degradation, together with the frame's number.
    title
        What the progress bar says.

    Raises
    ------
    JobError
        When none can be read, or a feature cannot be computed.
    """

    def describe(number: int) -> NDArray[np.float32] | None:
        path = folder.path / folder.frames[number]
        image = read_color(path)
        if image is None:
            return None
        try:
            return extract(image if conditions is None else conditions.degrade(image, seed, number), settings)
        except ValueError as error:
            raise JobError(f"{path}: {error}") from None

    with quiet_opencv(), ThreadPoolExecutor(_WORKERS) as pool:
        done = pool.map(describe, frames)
        described = list(tqdm(done, total=len(frames), desc=title, unit="image", dynamic_ncols=True, disable=None))
    rows = [one for one in described if one is not None]
    if not rows:
        raise JobError(f"{folder.path}: none of {len(frames)} images can be read")
    read = [number for number, one in zip(frames, described, strict=True) if one is not None]
    missing = [folder.frames[number] for number, one in zip(frames, described, strict=True) if one is None]
    return DescribedFrames(np.stack(rows), np.array(read, dtype=np.int64), tuple(missing))
