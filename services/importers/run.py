"""Execution of an import: read, resample and write.

`smal import` runs `work` in a separate process (`smal.files.confined`), because the libraries that
decode Parquet, video and images are written in C and C++.
"""

import importlib
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.base import ATOMS
from schemas.codec import printable
from services.importers.comparing import sound
from services.importers.drive import ImportedDrive, ImportFailure, Tally
from services.importers.inside import Inside
from services.importers.job import FORMATS, Format, ImportJob, ImportReport, OdometryOrigin
from services.importers.recording import Written, write
from services.importers.ticks import Nominal, nominal
from services.kit.errors import describe_os_error
from smal.files.confined import ConfinedError, Work

#: Modules of this package that read a format, by ``read(inside, job, tally)``.
_READERS: Final[dict[Format, str]] = {form: form for form in FORMATS} | {
    "folder": "csv_folder",
    "rosbag1": "rosbag2",
}
MOST_MEMORY: Final = 2 * 2**30  # In bytes; the numbers of the longest drive take a quarter.
_PERIOD_S: Final = 0.1  # Between two reports of progress, seconds.


def run(
    job: ImportJob, tally: Tally, advance: Callable[[int], None] = lambda _total: None
) -> ImportReport:
    """Import a source; ``advance`` is called with the number of all frames after each frame.

    Raises
    ------
    ImportFailure, OSError
        If the source cannot be read, or the recordings cannot be written.
    """
    try:
        read = _drives(job, tally)
        counts = tally.counts.copy()
        drives = [part for drive in read for part in sound(drive, tally)]
        tally.counts = counts  # The writer counts the compared images as it reads them again.
        usual = nominal(np.concatenate([drive.motion[:, 1:] for drive in drives]), job.quantile)
        total = sum(drive.times_s.size for drive in drives)
        found = [write(drive, job, usual, tally, lambda: advance(total)) for drive in drives]
        written = [one for one in found if one is not None]
        if not written:
            raise ImportFailure(f"{job.path}: nothing to import")
        return _report(drives, written, usual)
    except ImportFailure as error:
        # The cause can be among the counted defects.
        raise ImportFailure("; ".join([str(error), *tally.counted()])) from None


def _drives(job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    every = _read(Inside(Path(job.path)), job, tally)
    drives = [drive for drive in every if not job.episodes or drive.name in job.episodes]
    if not drives:
        names = ", ".join(drive.name for drive in every[:10]) or "none"
        raise ImportFailure(
            f"{job.path}: episodes {', '.join(job.episodes)} not found; choose from {names}"
        )
    return drives


def _reader(form: Format) -> Any:  # noqa: ANN401 - a module
    return importlib.import_module(f"services.importers.{_READERS[form]}")


def _read(inside: Inside, job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    """Read a source; an error about another format names what is there."""
    reader = _reader(job.format)
    read: Callable[[Inside, ImportJob, Tally], list[ImportedDrive]] = reader.read
    if reader.found(inside):
        return read(inside, job, tally)
    folder = inside if inside.is_folder else Inside(inside.path.parent)
    if others := [form for form in FORMATS if _reader(form).found(folder)]:
        raise ImportFailure(
            f"{inside.path}: not of the format {job.format}; run: smal import {others[0]} "
            f"{folder.path}"
        )
    names = inside.names() if inside.is_folder else [inside.path.name]
    kinds = Counter(Path(name).suffix or "(no suffix)" for name in names).most_common(5)
    named = printable(", ".join(f"{count} {kind}" for kind, count in kinds)) or "none"
    try:
        return read(inside, job, tally)
    except ImportFailure as error:
        raise ImportFailure(f"{error}; files there: {named}") from None


def _report(
    drives: Sequence[ImportedDrive], written: Sequence[Written], usual: Nominal
) -> ImportReport:
    made = sum((one.atoms for one in written), Counter[str]())
    odometry: OdometryOrigin = "none"
    if any(one.with_odometry for one in written):
        tracked = any(drive.track.size for drive in drives)
        odometry = "of the source" if tracked else "computed from velocities"
    return ImportReport(
        files=tuple(str(one.path) for one in written),
        ticks=made.total(),
        successes=sum(one.success for one in written),
        odometry=odometry,
        speed=usual.linear,
        turn_rate=usual.angular,
        metric=all(drive.metric for drive in drives),
        atoms={name: made[name] for name in ATOMS},
    )


def work(request: Any, child: Work) -> dict[str, Any]:  # noqa: ANN401 - JSON
    """Run a job, given as JSON, in a separate process; raise ConfinedError if it fails."""
    job = ImportJob.model_validate_json(json.dumps(request))
    tally = Tally()
    done = 0
    told_s = 0.0

    def advance(total: int) -> None:
        nonlocal done, told_s
        done += 1
        if time.monotonic() - told_s >= _PERIOD_S:
            told_s = time.monotonic()
            child.tell({"done": done, "total": max(total, done)})

    try:
        report = run(job, tally, advance)
    except ImportFailure as error:
        raise ConfinedError(str(error)) from None
    except OSError as error:
        raise ConfinedError(describe_os_error(error)) from None
    return {"remarks": tally.lines(), "report": report.model_dump(mode="json")}
