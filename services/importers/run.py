"""Execution of an import: read, resample and write.

`smal import` runs `work` in a separate process (`smal.files.confined`), because the libraries that
decode Parquet, video and images are written in C and C++.
"""

import importlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from schemas.base import ATOMS
from schemas.codec import printable
from services.importers.comparing import sound
from services.importers.drive import ImportedDrive, ImportFailure, Reads, Tally
from services.importers.images import aspect_of, rotated
from services.importers.inside import Inside
from services.importers.job import FORMATS, Format, ImportJob, ImportReport, OdometryOrigin
from services.importers.recording import Written, write
from services.importers.ticks import Nominal, nominal
from services.kit.cameras import turned
from services.kit.errors import describe_os_error
from smal.files.confined import ConfinedError, Work

#: Modules of this package that read a format, by ``read(inside, job, tally)``.
_READERS: Final[dict[Format, str]] = {form: form for form in FORMATS} | {
    "folder": "csv_folder",
    "rosbag1": "rosbag2",
}
MOST_MEMORY: Final = 2 * 2**30  # In bytes; the numbers of the longest drive take a quarter.
_ARCHIVES: Final = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar", ".zst", ".zstd")
_MOST_TURN: Final = 10.0  # Radians per second; a wheeled robot that turns on the spot does 5.
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
        upright = [_rotated(drive, job.rotate_deg) for drive in read]
        drives = _gathered([partial(sound, drive, tally) for drive in upright], tally)
        tally.counts = counts  # The writer counts the compared images as it reads them again.
        usual = nominal(np.concatenate([drive.motion[:, 1:] for drive in drives]), job.quantile)
        if usual.angular > _MOST_TURN and all(drive.metric for drive in drives):
            raise ImportFailure(
                f"{job.path}: usual turn rate too large ({usual.angular:.0f} rad/s, maximum "
                f"{_MOST_TURN:g}); if it is in degrees per second, give --turn-rate 0.0174533"
            )
        total = sum(drive.times_s.size for drive in drives)
        found = [write(drive, job, usual, tally, lambda: advance(total)) for drive in drives]
        written = [one for one in found if one is not None]
        if not written:
            raise ImportFailure(f"{job.path}: nothing to import")
        return _report(drives, written, usual)
    except ImportFailure as error:
        # The cause can be among the remarks and the counted defects.
        raise ImportFailure("; ".join([str(error), *tally.lines()])) from None


def _drives(job: ImportJob, tally: Tally) -> list[ImportedDrive]:
    """Read the requested drives; a drive that cannot be read is a remark if others can."""
    reads = _reads(Inside(Path(job.path)), job, tally)
    if not job.episodes:
        every = _gathered(reads.values(), tally)
        if not every:
            raise ImportFailure(f"{job.path}: no drives in this source")
        return every
    wanted = {name: read for name, read in reads.items() if _leads(name, job.episodes)}
    every = _gathered(wanted.values(), tally)
    drives = [drive for drive in every if drive.name in job.episodes]
    if not drives:
        others = [name for name in reads if name not in wanted]
        names = printable(", ".join([*(drive.name for drive in every), *others][:10])) or "none"
        raise ImportFailure(
            f"{job.path}: episodes {', '.join(job.episodes)} not found; choose from {names}"
        )
    return drives


def _rotated(drive: ImportedDrive, clockwise_deg: int) -> ImportedDrive:
    """Turn the images of a drive, and its camera with them."""
    if not clockwise_deg:
        return drive
    camera = drive.camera
    if camera is not None:
        aspect = aspect_of(drive.images)
        camera = None if aspect is None else turned(camera, clockwise_deg, aspect)
    return replace(drive, images=rotated(drive.images, clockwise_deg), camera=camera)


def _leads(name: str, episodes: Sequence[str]) -> bool:
    """Return whether one of the episodes can be in a part of the source with this name."""
    return any(episode.startswith(name.rstrip("/")) for episode in episodes)


def _gathered(
    reads: Iterable[Callable[[], list[ImportedDrive]]], tally: Tally
) -> list[ImportedDrive]:
    """Return all drives, and report those that fail; ImportFailure if all fail."""
    drives: list[ImportedDrive] = []
    failures: list[str] = []
    for read in reads:
        try:
            drives += read()
        except ImportFailure as error:
            failures.append(str(error))
    if failures and not drives:
        raise ImportFailure(failures[0])
    for failure in failures:
        tally.say(failure)
    return drives


def _reader(form: Format) -> Any:  # noqa: ANN401 - a module
    return importlib.import_module(f"services.importers.{_READERS[form]}")


def _reads(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the reads of a source; an error about another format names what is there."""
    reader = _reader(job.format)
    read: Callable[[Inside, ImportJob, Tally], Reads] = reader.read
    if reader.found(inside):
        return read(inside, job, tally)
    if others := [form for form in FORMATS if _reader(form).found(inside)]:
        raise ImportFailure(
            f"{inside.path}: not of the format {job.format}; run: smal import {others[0]} "
            f"{inside.path}"
        )
    if packed := next(filter(_is_archive, [inside.path.name, *inside.names()]), None):
        raise ImportFailure(
            f"{inside.path}: nothing of the format {job.format}; unpack {printable(packed)} first"
        )
    if not inside.is_folder:
        raise ImportFailure(
            f"{inside.path}: a file, not of the format {job.format}; to import its folder, run: "
            f"smal import {job.format} {inside.path.parent}"
        )
    kinds = Counter(Path(name).suffix or "(no suffix)" for name in inside.names()).most_common(5)
    named = printable(", ".join(f"{count} {kind}" for kind, count in kinds)) or "none"
    try:
        return read(inside, job, tally)
    except ImportFailure as error:
        raise ImportFailure(f"{error}; files there: {named}") from None


def _is_archive(name: str) -> bool:
    return name.lower().endswith(_ARCHIVES)


def _report(
    drives: Sequence[ImportedDrive], written: Sequence[Written], usual: Nominal
) -> ImportReport:
    made = sum((one.atoms for one in written), Counter[str]())
    camera = next((one.camera for one in written), None)
    odometry: OdometryOrigin = "none"
    if any(one.with_odometry for one in written):
        tracked = any(drive.track.size and not drive.reckoned for drive in drives)
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
        field_of_view_deg=None if camera is None else camera.field_deg,
    )


def work(request: Any, child: Work) -> dict[str, Any]:  # noqa: ANN401 - JSON
    """Run a job, given as JSON, in a separate process; raise ConfinedError if it fails."""
    job = ImportJob.model_validate_json(json.dumps(request))
    tally = Tally()
    done = 0
    reported_s = 0.0

    def advance(total: int) -> None:
        nonlocal done, reported_s
        done += 1
        if time.monotonic() - reported_s >= _PERIOD_S:
            reported_s = time.monotonic()
            child.tell({"done": done, "total": max(total, done)})

    try:
        report = run(job, tally, advance)
    except ImportFailure as error:
        raise ConfinedError(str(error)) from None
    except OSError as error:
        raise ConfinedError(describe_os_error(error)) from None
    return {"remarks": tally.lines(), "report": report.model_dump(mode="json")}
