"""Results of ``smal match`` as JSON, text and g2o."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np

from schemas.codec import printable
from services.experiments.matching.traverse import Traverse
from services.experiments.words import counted, table
from smal.arrays import evenly
from smal.evaluation.ground_truth import IntervalTruth
from smal.evaluation.precision_recall import PrecisionRecall, figures_of
from smal.evaluation.reliability import Reliability, known_from_unknown
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.methods import MatchSettings

_SHOWN: Final = 12  # Number of matches to print if they are not written to a file.


@dataclass(frozen=True, eq=False)
class MatchQuality:
    """Quality of matches: curve, reliability, and numbers with 95 % intervals by name."""

    curve: PrecisionRecall
    reliability: Reliability | None
    figures: dict[str, float | tuple[float, float]]

    @classmethod
    def of(cls, matches: Matches, truth: IntervalTruth, length: int, *, probable: bool) -> Self:
        """Evaluate the matches of a method with windows of this length."""
        judgement = truth.judge(matches)
        curve = PrecisionRecall.of(judgement)
        reliability = Reliability.of(judgement) if probable else None
        known = known_from_unknown(judgement, 1.0 - matches.unknown if probable else matches.score)
        figures: dict[str, float | tuple[float, float]] = {
            "judged": int(truth.judged.sum()),
            "to_find": int(truth.findable.sum()),
        }
        figures |= figures_of(curve, judgement, length)
        figures |= {} if reliability is None else {"calibration_error": reliability.error}
        figures |= {} if known is None else {"known_from_unknown": known}
        return cls(curve, reliability, figures)


@dataclass(frozen=True, eq=False)
class Result:
    """Settings and results; matches are numbered as the sources, `unsure` counts filtered matches."""

    chosen: dict[str, object]
    settings: MatchSettings
    references: Traverse
    queries: Traverse
    matches: Matches
    unsure: int
    quality: MatchQuality | None
    seconds: dict[str, float]
    probable: bool  # Whether scores are probabilities.


def in_sources(matches: Matches, references: Traverse, queries: Traverse) -> Matches:
    """Convert rows of the features of readable frames to frame numbers."""
    count = len(queries.source.frames)
    found = Matches.none(count)
    where = queries.numbers[matches.matched]
    found.reference[where] = references.numbers[matches.reference[matches.matched]]
    found.score[queries.numbers] = matches.score
    found.unknown[queries.numbers] = matches.unknown
    return found


def as_json(result: Result) -> str:
    """Return the result for ``--json``."""
    found = result.matches
    rows = zip(found.reference.tolist(), found.score.tolist(), found.unknown.tolist(), strict=True)
    references = result.references
    queries = result.queries
    features = result.settings.features
    written: dict[str, object] = {
        **result.chosen,
        "references": str(references.source.path),
        "queries": str(queries.source.path),
        "matches": [
            {
                "query": query,
                "reference": None if reference == NONE else reference,
                "score": score,
                "unknown": unknown,
            }
            for query, (reference, score, unknown) in enumerate(rows)
        ],
        "modalities": list(features.modalities),
        "reference_names": _printable(references.source.frames),
        "query_names": _printable(queries.source.frames),
        "unreadable_references": _printable(references.unreadable),
        "unreadable_queries": _printable(queries.unreadable),
        "other_files": len(references.source.others) + len(queries.source.others),
        "seconds": {stage: round(seconds, 3) for stage, seconds in result.seconds.items()},
    }
    written |= {} if result.quality is None else result.quality.figures
    return json.dumps(written, indent=2) + "\n"


def as_text(result: Result, written: list[Path]) -> Iterator[str]:
    """Yield the printed lines; `written` are the files of results."""
    matches = result.matches
    rows = {
        "chosen": title_of(result),
        "features": " ".join(result.settings.features.modalities),
        "references": _frames(result.references),
        "queries": _frames(result.queries),
        "matched": f"{matches.matched.sum()} of {matches.matched.size} query frames{_why_not_all(result)}",
        "seconds": ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items()),
    }
    for name, figure in ({} if result.quality is None else result.quality.figures).items():
        parts = figure if isinstance(figure, tuple) else (figure,)
        rows[name.replace("_", " ")] = " to ".join(str(round(part, 3)) for part in parts)
    if written:
        rows["written"] = ", ".join(map(str, written))
    width = max(map(len, rows)) + 2
    yield from (f"{name:{width}}{value}" for name, value in rows.items())
    if not written:
        yield ""
        yield from _some_matches(result)


def as_g2o(result: Result) -> str:
    """Return loops as edges of a pose graph: no shift, the score as information, 0 for the heading."""
    found = result.matches
    return "".join(
        f"EDGE_SE2 {found.reference[query]} {query} 0 0 0 {found.score[query]:.6g} 0 0 {found.score[query]:.6g} 0 0\n"
        for query in np.flatnonzero(found.matched)
    )


def title_of(result: Result) -> str:
    """Return a title of the method and the chosen options."""
    return ", ".join(
        f"{name} {value}" for name, value in result.chosen.items() if value is not None
    )


def _why_not_all(result: Result) -> str:
    reasons = {"unsure": result.unsure, "unreadable": len(result.queries.unreadable)}
    reasons["before the first window"] = result.settings.length - 1
    reasons["unlike every reference"] = int((~result.matches.matched).sum()) - sum(reasons.values())
    said = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
    return f" ({said})" if said else ""


def _frames(traverse: Traverse) -> str:
    unreadable = f" ({len(traverse.unreadable)} of them unreadable)" if traverse.unreadable else ""
    return f"{counted(len(traverse.source.frames), 'frame')}{unreadable} in {traverse.source.path}"


def _some_matches(result: Result) -> Iterator[str]:
    """Yield a few evenly spaced matches; a file takes all of them."""
    matches = result.matches
    count = result.matches.matched.size
    shown = evenly(count, _SHOWN).tolist()
    references, queries = (
        _printable(one.source.frames) for one in (result.references, result.queries)
    )
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
