"""Laps from a tub of donkeycar or from recordings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.laps.finding import Frames, Lap, find_laps
from services.experiments.words import remark
from services.importers import donkeycar
from services.importers.drive import Tally
from services.importers.inside import Inside
from services.importers.job import ImportJob
from services.importers.run import run
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import Teacher, find_recordings
from smal.features import Centering, FeatureSettings, select
from smal.movement import Atom, dead_reckoning, seen_from
from smal.teaching.demonstration import Demonstration

#: Features to evaluate. Laps are detected and aligned with other features, so frames have both.
JUDGED = FeatureSettings()
_FINDING = FeatureSettings.of(("gist", "thumbnail"))
HELD: Final = FeatureSettings.of((*JUDGED.modalities, *_FINDING.modalities))
# A turn difference of one standard deviation counts like a cosine of .75 between views.
_TURN_WEIGHT: Final = 0.25


def read_laps(
    source: Path, advance: Callable[[str, int, int], None], rate_hz: float | None = None
) -> list[tuple[Demonstration, Lap]]:
    """Find laps in a tub or in recordings, ordered as by `find_laps`.

    The frame rate replaces the times of a tub.

    Raises
    ------
    UsageError
        If the source has no usable drive.
    JobError
        If there are fewer than three laps.
    """
    tub = source.is_dir() and donkeycar.found(Inside(source))
    if rate_hz is not None and not tub:
        raise UsageError(f"--rate has no effect on {source}, which is no tub; omit it")
    tally = Tally()
    with TemporaryDirectory() as folder:
        if tub:
            # The units of speed and turn rate are unknown.
            speeds = {"speed": 1.0, "turn_rate": 1.0, "rate_hz": rate_hz}
            job = {"format": "donkeycar", "path": str(source), "folder": folder, "robot": "car"}
            run(ImportJob.model_validate(job | speeds), tally)
        files = find_recordings([Path(folder) if tub else source])
        teaching = Teacher(HELD, shortest=2).read_all(files, advance)
    remarks = tally.lines() if tub else teaching.lines()
    try:
        laps = laps_of(teaching.demonstrations, reckoned=tub)
    except JobError as error:
        raise JobError("; ".join([f"{source}: {error}", *remarks])) from None
    remark(remarks)
    return laps


def laps_of(
    drives: Sequence[Demonstration], *, reckoned: bool = False
) -> list[tuple[Demonstration, Lap]]:
    """Find laps in drives with the features `HELD`; scale the turns of a tub to one turn per lap."""
    drives = [replace(one, features=one.rows) for one in drives if one.images is not None]
    turns = [_turns(one) for one in drives]
    laps = find_laps(_frames(drives, turns)) if drives else []
    if len(laps) < 3:
        raise JobError(f"found {len(laps)} whole laps; at least 3 are needed")
    if reckoned:
        times = _times_to_turn_once([turns[lap.piece][lap.first : lap.last] for lap in laps])
        drives = [_turning(one, times) for one in drives]
    return [(_part(drives[lap.piece], lap.first, lap.last), lap) for lap in laps]


def _times_to_turn_once(turns: Sequence[NDArray[np.float64]]) -> float:
    """Return the factor with which the median lap turns once; raise JobError for turns to both sides."""
    round_rad = abs(float(np.median([turn.sum() for turn in turns])))
    if round_rad <= float(np.median([np.abs(turn).sum() for turn in turns])) / 2.0:
        raise JobError(
            "laps turn to both sides; import the source with --speed and --turn-rate, and give "
            "the result"
        )
    return math.tau / round_rad


def _turns(drive: Demonstration) -> NDArray[np.float64]:
    """Return the left turn after each frame, (f,): radians by odometry, or 1 for a turn command."""
    turned: NDArray[np.float64]
    if drive.odometry is None:
        turned = 1.0 * (drive.atoms == Atom.LEFT) - (drive.atoms == Atom.RIGHT)
        return turned
    turned = seen_from(drive.odometry[1:], drive.odometry[:-1])[:, 2]
    return np.append(turned, 0.0)


def _frames(drives: Sequence[Demonstration], turns: Sequence[NDArray[np.float64]]) -> list[Frames]:
    raw = [select(one.rows, HELD, _FINDING) for one in drives]
    every = np.concatenate(turns)
    centering = Centering.fit(raw, _FINDING)
    scale = math.sqrt(2.0 * _TURN_WEIGHT) / max(float(every.std()), 1e-9)
    both = zip(raw, turns, strict=True)
    return [
        np.column_stack([centering.apply(each), scale * (turn - every.mean())])
        for each, turn in both
    ]


def _turning(drive: Demonstration, times: float) -> Demonstration:
    assert drive.odometry is not None  # noqa: S101 - it was asked for
    steps = seen_from(drive.odometry[1:], drive.odometry[:-1])[:, [0, 2]] * (1.0, times)
    return replace(
        drive, odometry=dead_reckoning(np.arange(len(drive.atoms)), np.vstack([steps, np.zeros(2)]))
    )


def _part(drive: Demonstration, first: int, last: int) -> Demonstration:
    of_frames = {
        name: getattr(drive, name) for name in ("features", "atoms", "images", "odometry", "ahead")
    }
    cut: dict[str, Any] = {
        name: None if every is None else every[first:last] for name, every in of_frames.items()
    }
    cut["features"] = select(cut["features"], HELD, JUDGED)
    return replace(
        drive,
        name=f"{drive.name}, frames {first} to {last - 1}",
        episode="",
        successful=True,
        **cut,
    )
