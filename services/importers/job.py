"""One import: read, resample, write."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

import numpy as np
from pydantic import Field

from schemas.base import ATOMS, RobotId, Strict
from schemas.episode import GoalName
from services.importers.atoms import Thresholds, nominal
from services.importers.drive import LEAST_FOCAL, MOST_FOCAL, ImportFailure, Source, Tally
from services.importers.inside import Inside
from services.importers.source_options import Wishes
from services.importers.writing import Purpose, Written, write
from services.kit.errors import UsageError

Format = Literal["rosbag2", "lerobot", "donkeycar", "folder"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)
#: Where each is read, and what has to be installed for it.
_READERS: Final = {
    "rosbag2": ("services.importers.rosbag2", ("rosbags",)),
    "lerobot": ("services.importers.lerobot", ("pyarrow", "av")),
    "donkeycar": ("services.importers.donkeycar", ()),
    "folder": ("services.importers.csv_folder", ()),
}
_Fraction = Annotated[float, Field(gt=0.0, le=1.0)]


class Job(Strict):
    """What is asked for."""

    format: Format
    """Which reader."""
    path: str
    """The source."""
    folder: str
    """Where to write."""
    robot: RobotId
    """Name of the robot."""
    goal: GoalName = "victim"
    """Where the drives lead."""
    success: bool | None = None
    """Whether they got there, whatever the source says."""
    reckon: bool = True
    """Whether to reckon a way from velocities."""
    from_s: Annotated[float, Field(ge=0.0, le=1e9)] = 0.0
    """Leave out what was before, of each drive."""
    to_s: Annotated[float, Field(gt=0.0, le=1e9)] = 1e9
    """Leave out what was after, of each drive."""
    focal: Annotated[float, Field(ge=LEAST_FOCAL, le=MOST_FOCAL)] | None = None
    """Focal length over the image's width."""
    quantile: _Fraction = Thresholds().quantile
    """See `Thresholds`."""
    still: _Fraction = Thresholds().still
    """See `Thresholds`."""
    turning: _Fraction = Thresholds().turning
    """See `Thresholds`."""
    wishes: Wishes = Wishes()
    """Of the reader."""


class Report(Strict):
    """What came of it."""

    files: tuple[str, ...]
    """Recordings."""
    ticks: int
    """In all of them."""
    successes: int
    """Drives that reached the goal."""
    odometry: Literal["of the source", "reckoned from velocities", "none"]
    """What teaches how far the robot went."""
    speed: float
    """Nominal speed, in the source's units."""
    turn_rate: float
    """Nominal turn rate, in the source's units."""
    metric: bool
    """Whether these units are metres and radians a second."""
    atoms: dict[str, int]
    """How many of each."""


#: Called with frames done and their number.
Progress = Callable[[int, int], None]


def missing_packages(form: Format) -> list[str]:
    """Return what has to be installed for a format and is not."""
    return [name for name in _READERS[form][1] if importlib.util.find_spec(name) is None]


def check_format(name: str, formats: Sequence[Format] = FORMATS) -> Format:
    """Return the format of a name; what it needs is installed.

    Raises
    ------
    UsageError
        When there is none of that name, or something that it needs is missing.
    """
    form = next((one for one in formats if one == name), None)
    if form is None:
        raise UsageError(f"no format {name!r}; known are: {', '.join(formats)}")
    if missing := missing_packages(form):
        raise UsageError(f"{form} needs {' and '.join(missing)}: pip install -e '.[formats]'")
    return form


def run(job: Job, tally: Tally, progress: Progress = lambda _done, _total: None) -> Report:
    """Import.

    Raises
    ------
    ImportFailure
        When nothing can be imported.
    OSError
        When it cannot be written.
    """
    try:
        return _run(job, tally, progress)
    except ImportFailure as error:
        # What did not fit may be why.
        raise ImportFailure("; ".join([str(error), *tally.counted()])) from None


def _run(job: Job, tally: Tally, progress: Progress) -> Report:
    reader = importlib.import_module(_READERS[job.format][0])
    source: Source = reader.read(Inside(Path(job.path)), job.wishes, tally)
    drives = [d for d in source.drives if not job.wishes.episodes or d.name in job.wishes.episodes]
    if not drives:
        names = ", ".join(drive.name for drive in source.drives[:10]) or "none"
        raise ImportFailure(f"{job.path}: none of the episodes {', '.join(job.wishes.episodes)}; there are: {names}")
    thresholds = Thresholds(job.quantile, job.still, job.turning)
    samples = [np.stack([drive.motion.linear, drive.motion.angular]) for drive in drives]
    usual = nominal(np.concatenate(samples, axis=1), thresholds)
    purpose = Purpose(
        job.robot, job.goal, job.format, job.success, job.reckon and source.metric, job.from_s, job.to_s, job.focal
    )
    total, done = sum(drive.count for drive in drives), 0

    def advance(frames: int) -> None:
        nonlocal done
        done += frames
        progress(done, max(total, done))

    found = [write(Path(job.folder), drive, purpose, usual, thresholds, tally, advance) for drive in drives]
    written = [one for one in found if one is not None]
    if not written:
        raise ImportFailure(f"{job.path}: nothing to import")
    tracked = any(drive.track is not None for drive in drives)
    made = np.concatenate([one.atoms for one in written])
    return Report(
        files=tuple(str(one.path) for one in written),
        ticks=sum(one.ticks for one in written),
        successes=sum(one.success for one in written),
        odometry=_odometry(written, tracked=tracked),
        speed=usual.linear,
        turn_rate=usual.angular,
        metric=source.metric,
        atoms={name: int((made == number).sum()) for number, name in enumerate(ATOMS)},
    )


def _odometry(written: list[Written], *, tracked: bool) -> Literal["of the source", "reckoned from velocities", "none"]:
    if not any(one.with_odometry for one in written):
        return "none"
    return "of the source" if tracked else "reckoned from velocities"
