"""What ``smal match`` answers, as JSON and for people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from services.experiments.matching.image_folder import DescribedFrames, ImageFolder, printable
from services.kit.tables import table
from smal.evaluation.precision_recall import Intervals, PrecisionRecall
from smal.features import FeatureSettings
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.methods import MatchSettings

#: Matches that are printed where no file takes them all.
_SHOWN: Final = 12


@dataclass(frozen=True, eq=False)
class Traverses:
    """The two folders, and what of them is compared."""

    references: ImageFolder
    queries: ImageFolder
    reference_frames: DescribedFrames
    query_frames: DescribedFrames

    def in_folders(self, matches: Matches) -> Matches:
        """Turn rows of the features into numbers of frames.

        Windows run over the frames that could be read; a query that could not has no match.
        """
        count = len(self.queries.frames)
        reference, score = np.full(count, NONE, dtype=np.int64), np.zeros(count)
        found = matches.matched
        where = self.query_frames.numbers[found]
        reference[where] = self.reference_frames.numbers[matches.reference[found]]
        score[where] = matches.score[found]
        return Matches(reference, score)


@dataclass(frozen=True, eq=False)
class Quality:
    """How good the matches are: the curve, its 95 % intervals, how many queries were judged, and were to be found."""

    curve: PrecisionRecall
    intervals: Intervals
    judged: int
    to_find: int


@dataclass(frozen=True, eq=False)
class Result:
    """What was asked for, and what came out: matches numbered as the folders are.

    ``unsure`` matches with a score of at most ``tau`` were left out; ``seconds`` is the time of each stage.
    """

    name: str
    settings: MatchSettings
    tau: float | None
    traverses: Traverses
    matches: Matches
    unsure: int
    quality: Quality | None
    seconds: dict[str, float]


def as_json(result: Result) -> dict[str, object]:
    """Return the result as ``--json`` writes it."""
    pairs = zip(result.matches.reference.tolist(), result.matches.score.tolist(), strict=True)
    folders = result.traverses
    written: dict[str, object] = {
        "method": result.name,
        "length": result.settings.length,
        "tau": result.tau,
        "references": str(folders.references.path),
        "queries": str(folders.queries.path),
        "matches": [
            {"query": query, "reference": None if reference == NONE else reference, "score": score}
            for query, (reference, score) in enumerate(pairs)
        ],
    }
    if result.quality is not None:
        curve, intervals = result.quality.curve, result.quality.intervals
        written |= {
            "auc": curve.auc,
            "auc_95": list(intervals.auc),
            "recall_at_100_precision": curve.recall_at_100_precision,
            "recall_at_100_precision_95": list(intervals.recall_at_100_precision),
            "judged": result.quality.judged,
            "to_find": result.quality.to_find,
        }
    return written | {
        "modalities": list(result.settings.features.modalities),
        "penalty": result.settings.penalty,
        "weights": list(result.settings.features.weights),
        "reference_names": [printable(name) for name in folders.references.frames],
        "query_names": [printable(name) for name in folders.queries.frames],
        "unreadable_references": [printable(name) for name in folders.reference_frames.unreadable],
        "unreadable_queries": [printable(name) for name in folders.query_frames.unreadable],
        "other_files": len(folders.references.others) + len(folders.queries.others),
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
    }


def as_text(result: Result, written: list[Path]) -> Iterator[str]:
    """Yield the lines that are printed; `written` are the files of results."""
    folders, matches = result.traverses, result.matches
    rows = {
        "method": f"{result.name}, {_windows(result.settings)}",
        "features": described_by(result.settings.features),
        "references": _frames(folders.references, folders.reference_frames),
        "queries": _frames(folders.queries, folders.query_frames),
        "matched": f"{matches.matched.sum()} of {matches.matched.size} query frames{_why_not_all(result)}",
        "seconds": ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()),
    }
    if result.quality is not None:
        curve, intervals = result.quality.curve, result.quality.intervals
        rows["judged"] = f"{result.quality.judged} query frames, {result.quality.to_find} of them to be found"
        rows["AUC"] = _with_interval(curve.auc, intervals.auc)
        rows["recall at 100 % precision"] = _with_interval(
            curve.recall_at_100_precision, intervals.recall_at_100_precision
        )
    if written:
        rows["written"] = ", ".join(map(str, written))
    width = max(map(len, rows)) + 2
    yield from (f"{name:{width}}{value}" for name, value in rows.items())
    if not written:
        yield ""
        yield from _some_matches(result)


def _windows(settings: MatchSettings) -> str:
    windows = "single frames" if settings.length == 1 else f"windows of {settings.length} frames"
    return windows if settings.penalty is None else f"{windows}, penalty {settings.penalty:g}"


def _why_not_all(result: Result) -> str:
    """Explain the frames without a match."""
    unreadable, early = len(result.traverses.query_frames.unreadable), result.settings.length - 1
    nothing = result.matches.matched.size - int(result.matches.matched.sum()) - unreadable - early - result.unsure
    reasons = {
        "before the first window": early,
        "unreadable": unreadable,
        "like no reference": nothing,
        f"not above tau {result.tau or 0.0:g}": result.unsure,
    }
    said = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
    return f" ({said})" if said else ""


def _frames(folder: ImageFolder, described: DescribedFrames) -> str:
    unreadable = f" ({len(described.unreadable)} of them unreadable)" if described.unreadable else ""
    frames = "1 frame" if len(folder.frames) == 1 else f"{len(folder.frames)} frames"
    return f"{frames}{unreadable} in {folder.path}"


def described_by(features: FeatureSettings) -> str:
    """Name the modalities, and their weights unless all are the same."""
    if len(set(features.weights)) == 1:
        return " ".join(features.modalities)
    pairs = zip(features.modalities, features.weights, strict=True)
    return " ".join(f"{name} (weight {weight:g})" for name, weight in pairs)


def _with_interval(value: float, interval: tuple[float, float]) -> str:
    return f"{value:.3f} (95 % interval {interval[0]:.3f} to {interval[1]:.3f})"


def _some_matches(result: Result) -> Iterator[str]:
    """Yield a few matches, evenly spread; all of them are for a file."""
    matches, folders = result.matches, result.traverses
    count = matches.matched.size
    shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).astype(int)).tolist()
    rows = [["query", "", "reference", "", "score"]]
    for query in shown:
        found = ["-", "", "-"]
        if (reference := int(matches.reference[query])) != NONE:
            name = printable(folders.references.frames[reference])
            found = [str(reference), name, f"{matches.score[query]:.3f}"]
        rows.append([str(query), printable(folders.queries.frames[query]), *found])
    yield from table(rows, left=4)
    if len(shown) < count:
        yield f"{len(shown)} of {count} query frames; --json FILE writes every match"
