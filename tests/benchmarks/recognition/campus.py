"""Frames that our simulator rendered along the expert's drives on the campus."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

from services.recordings.dataset import Teacher, find_recordings
from smal.features import Centering, FeatureSettings
from tests.benchmarks.drives import demonstrate
from tests.benchmarks.recognition.datasets import Recorded
from tests.benchmarks.results import LeftOutError

#: Of so many drives one is held out for queries.
_HELD_OUT_OF: Final = 6


def campus(recordings: Path | None, episodes: int, recoveries: int) -> Recorded:
    """Read drives, or have them driven first into a folder that is removed again.

    Raises
    ------
    LeftOutError
        They cannot be driven here (no Vulkan driver, ...), or are too few.
    """
    if recordings is not None:
        return _read(recordings)
    with tempfile.TemporaryDirectory(prefix="smal-bench-") as folder:
        demonstrate(Path(folder), episodes, recoveries)
        return _read(Path(folder))


def _read(folder: Path) -> Recorded:
    settings = FeatureSettings()
    teacher = Teacher(settings, shortest=1)
    for path in find_recordings([folder]):
        teacher.read(path)
    demonstrations = teacher.teaching.demonstrations
    drives = [one for one in demonstrations if not one.recovery]
    if len(drives) < 2:
        remarks = teacher.teaching.remarks
        raise LeftOutError(f"{len(drives)} usable drives, 2 are needed" + (f" ({remarks[0]})" if remarks else ""))
    queries = drives[-max(1, len(drives) // _HELD_OUT_OF) :]
    taught = [one for one in demonstrations if one not in queries]
    centering = Centering.fit([one.features for one in taught], settings)
    return Recorded(
        "campus",
        [centering.apply(one.features) for one in taught],
        [centering.apply(one.features) for one in queries],
    )
