"""What ``smal match`` answers, as JSON and for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from schemas.codec import printable
from services.experiments.matching.image_folder import Traverse
from services.experiments.words import counted, described_by
from services.kit.tables import table
from smal.evaluation.precision_recall import Intervals, PrecisionRecall
from smal.evaluation.reliability import Reliability
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.methods import MatchSettings

#: Matches that are printed where no file takes them all.
_SHOWN: Final = 12


@dataclass(frozen=True, eq=False)
class Quality:
    """How good the matches are: the curve, its 95 % intervals, how many queries were judged, and were to be found.

    Where scores are probabilities, how right they are; and where queries are judged that no reference shows, how often
    a known one is told from an unknown one.
    """

    curve: PrecisionRecall
    intervals: Intervals
    judged: int
    to_find: int
    reliability: Reliability | None
    known_from_unknown: float | None


@dataclass(frozen=True, eq=False)
class Result:
    """What was asked for, and what came out: matches numbered as the folders are.

    ``unsure`` matches were left out for ``tau`` and ``precision``; ``seconds`` is the time of each stage.
    """

    name: str
    settings: MatchSettings
    tau: float | None
    precision: float | None
    references: Traverse
    queries: Traverse
    matches: Matches
    unsure: int
    quality: Quality | None
    seconds: dict[str, float]


def in_folders(matches: Matches, references: Traverse, queries: Traverse) -> Matches:
    """Turn rows of the features into numbers of frames.

    Windows run over the frames that could be read; a query that could not has no match.
    """
    count = len(queries.folder.frames)
    found = Matches.none(count)
    where = queries.numbers[matches.matched]
    found.reference[where] = references.numbers[matches.reference[matches.matched]]
    found.score[queries.numbers], found.unknown[queries.numbers] = matches.score, matches.unknown
    return found


def as_json(result: Result) -> dict[str, object]:
    """Return the result as ``--json`` writes it."""
    found = result.matches
    rows = zip(found.reference.tolist(), found.score.tolist(), found.unknown.tolist(), strict=True)
    references, queries, settings = result.references, result.queries, result.settings
    written: dict[str, object] = {
        "method": result.name,
        "length": settings.length,
        "tolerance": settings.tolerance,
        "online": settings.lag,
        "tau": result.tau,
        "precision": result.precision,
        "references": str(references.folder.path),
        "queries": str(queries.folder.path),
        "matches": [
            {"query": query, "reference": None if reference == NONE else reference, "score": score, "unknown": unknown}
            for query, (reference, score, unknown) in enumerate(rows)
        ],
        "modalities": list(settings.features.modalities),
        "weights": list(settings.features.weights),
        "reference_names": _printable(references.folder.frames),
        "query_names": _printable(queries.folder.frames),
        "unreadable_references": _printable(references.unreadable),
        "unreadable_queries": _printable(queries.unreadable),
        "other_files": len(references.folder.others) + len(queries.folder.others),
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
    }
    if (quality := result.quality) is not None:
        written |= {
            "auc": quality.curve.auc,
            "auc_95": list(quality.intervals.auc),
            "recall_at_100_precision": quality.curve.recall_at_100_precision,
            "recall_at_100_precision_95": list(quality.intervals.recall_at_100_precision),
            "calibration_error": None if quality.reliability is None else quality.reliability.error,
            "known_from_unknown": quality.known_from_unknown,
            "judged": quality.judged,
            "to_find": quality.to_find,
        }
    return written


def as_text(result: Result, written: list[Path]) -> Iterator[str]:
    """Yield the lines that are printed; `written` are the files of results."""
    matches, settings = result.matches, result.settings
    rows = {
        "method": title_of(result),
        "features": described_by(settings.features),
        "references": _frames(result.references),
        "queries": _frames(result.queries),
        "matched": f"{matches.matched.sum()} of {matches.matched.size} query frames{_why_not_all(result)}",
        "seconds": ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()),
    }
    if (quality := result.quality) is not None:
        curve, intervals = quality.curve, quality.intervals
        rows["judged"] = f"{quality.judged} query frames, {quality.to_find} of them to be found"
        rows["AUC"] = _with_interval(curve.auc, intervals.auc)
        rows["recall at 100 % precision"] = _with_interval(
            curve.recall_at_100_precision, intervals.recall_at_100_precision
        )
        if quality.reliability is not None:
            rows["calibration error"] = f"{quality.reliability.error:.3f}"
        if quality.known_from_unknown is not None:
            rows["known from unknown"] = f"{quality.known_from_unknown:.3f} of pairs"
    if written:
        rows["written"] = ", ".join(map(str, written))
    width = max(map(len, rows)) + 2
    yield from (f"{name:{width}}{value}" for name, value in rows.items())
    if not written:
        yield ""
        yield from _some_matches(result)


def title_of(result: Result) -> str:
    """Return the method and what was chosen of it."""
    chosen = {
        "windows of {} frames": result.settings.length if result.settings.length > 1 else None,
        "right within {} frames": result.settings.tolerance,
        "{} frames later": result.settings.lag,
        "scores above {:g}": result.tau,
        "{:g} of them right": result.precision,
    }
    return ", ".join([result.name, *(text.format(value) for text, value in chosen.items() if value is not None)])


def _why_not_all(result: Result) -> str:
    """Explain the frames without a match."""
    unreadable, early, matched = len(result.queries.unreadable), result.settings.length - 1, result.matches.matched
    reasons = {
        "before the first window": early,
        "unreadable": unreadable,
        "like no reference": int((~matched).sum()) - unreadable - early - result.unsure,
        "unsure": result.unsure,
    }
    said = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
    return f" ({said})" if said else ""


def _frames(traverse: Traverse) -> str:
    unreadable = f" ({len(traverse.unreadable)} of them unreadable)" if traverse.unreadable else ""
    return f"{counted(len(traverse.folder.frames), 'frame')}{unreadable} in {traverse.folder.path}"


def _with_interval(value: float, interval: tuple[float, float]) -> str:
    return f"{value:.3f} (95 % interval {interval[0]:.3f} to {interval[1]:.3f})"


def _some_matches(result: Result) -> Iterator[str]:
    """Yield a few matches, evenly spread; all of them are for a file."""
    matches, count = result.matches, result.matches.matched.size
    shown = np.unique(np.linspace(0, count - 1, min(count, _SHOWN)).astype(int)).tolist()
    references, queries = (_printable(one.folder.frames) for one in (result.references, result.queries))
    rows = [["query", "", "reference", "", "score"]]
    for query in shown:
        reference = int(matches.reference[query])
        found = [str(reference), references[reference], f"{matches.score[query]:.3f}"]
        rows.append([str(query), queries[query], *(["-", "", "-"] if reference == NONE else found)])
    yield from table(rows, left=4)
    if len(shown) < count:
        yield f"{len(shown)} of {count} query frames; --json FILE writes every match"


def _printable(names: Sequence[str]) -> list[str]:
    return [printable(name, 255) for name in names]
