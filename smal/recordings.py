"""Recordings of this project, as demonstrations: the one door from the library to the services.

The format of recordings belongs to the services, so reading needs the packages of ``smal[stack]``.
"""

import os
import warnings
from pathlib import Path

from smal.features import FeatureSettings
from smal.teaching.demonstration import Demonstration


def read(
    path: str | os.PathLike[str], features: FeatureSettings | None = None
) -> list[Demonstration]:
    """Read every episode of a recording, or of all recordings in a folder.

    Parameters
    ----------
    path : path
        Recording (MCAP), or folder of recordings.
    features : FeatureSettings, optional
        Features of the demonstrations; they and the images are computed on access.

    Returns
    -------
    list of Demonstration
        `images`, `atoms` (the executed actions), `odometry` (the poses), `camera`, `goal` and
        `successful` of each episode, in parts if frames are missing; the input of `smal.learn`. A
        warning names episodes that cannot be read.

    Raises
    ------
    ValueError
        If there is no usable episode.
    ImportError
        If packages of ``smal[stack]`` are missing.

    Examples
    --------
    >>> model = smal.learn(smal.recordings.read("drives"))  # doctest: +SKIP
    """
    try:
        from services.kit.errors import UsageError  # noqa: PLC0415 - of the stack
        from services.recordings.dataset import Teacher, find_recordings  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise ImportError(
            f"reading recordings needs {error.name}: pip install 'smal[stack]'"
        ) from None
    teacher = Teacher(features or FeatureSettings(), shortest=1, everything=True)
    try:
        files = find_recordings([Path(path)])
    except UsageError as error:
        raise ValueError(str(error)) from None
    for file in files:
        teacher.read(file)
    teaching = teacher.teaching
    if not teaching.demonstrations:
        raise ValueError("; ".join(teaching.lines()))
    for line in teaching.lines():
        warnings.warn(line, stacklevel=2)
    return teaching.demonstrations
