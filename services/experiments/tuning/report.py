"""What ``smal tune`` answers, as JSON and for people."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from services.experiments.matching.report import described_by
from services.kit.tables import table
from smal.place_recognition.methods import MatchSettings
from smal.tuning.cross_validation import Figure
from smal.tuning.recommendation import Tried, Tuning

#: Settings that are printed; the JSON has all.
_SHOWN: Final = 10
#: Columns of the text.
_WIDTH: Final = 100


@dataclass(frozen=True)
class Unlabelled:
    """What was done to have labels.

    Parameters
    ----------
    length : int
        Window l that is recommended; the trials have windows of one frame.
    conditions : tuple of str
        How the queries were degraded, one trial each.
    """

    length: int
    conditions: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Report:
    """What was asked for, and what came out.

    Parameters
    ----------
    method : str
    references : Path
    queries, truth : Path, optional
        None without labels.
    unlabelled : Unlabelled, optional
        Without labels.
    candidates : bool
        Whether the modalities were given, so that the start is all of them with equal weights and not the defaults.
    precision : float
        Of the answers above tau.
    tuning : Tuning
    seconds : dict
        Time of each stage.
    """

    method: str
    references: Path
    queries: Path | None
    truth: Path | None
    unlabelled: Unlabelled | None
    candidates: bool
    precision: float
    tuning: Tuning
    seconds: dict[str, float]

    @property
    def recommended(self) -> MatchSettings:
        """Settings for the folders."""
        settings = self.tuning.recommended
        return settings if self.unlabelled is None else replace(settings, length=self.unlabelled.length)

    @property
    def start(self) -> str:
        """What the settings are called that others are compared with."""
        return "equal weights" if self.candidates else "defaults"

    @property
    def lambdas(self) -> tuple[float, float] | None:
        """lambda1 and lambda2 of Eq. 7, of the recommended settings of the method `paper`."""
        settings = self.recommended
        if self.method != "paper" or settings.penalty is None:
            return None
        scale = settings.penalty * math.sqrt(settings.length)
        return scale, scale

    @property
    def match_command(self) -> str:
        """The command line with the recommended settings; without tau, which leaves answers out."""
        settings = self.recommended
        words = ["smal", "match", str(self.references), str(self.queries or "QUERY_DIR"), "--method", self.method]
        words += [*_feature_flags(settings), "--length", str(settings.length)]
        words += [] if settings.penalty is None else ["--penalty", f"{settings.penalty:g}"]
        return shlex.join(words)

    @property
    def learn_command(self) -> str | None:
        """The same for ``smal learn``, of the method `paper`."""
        if self.lambdas is None:
            return None
        settings = self.recommended
        words = ["smal", "learn", "RECORDINGS", "--out", "MODEL", *_feature_flags(settings)]
        words += ["--length", str(settings.length)]
        words += ["--lambda1", f"{self.lambdas[0]:.4g}", "--lambda2", f"{self.lambdas[1]:.4g}"]
        return shlex.join(words)


def _feature_flags(settings: MatchSettings) -> list[str]:
    weights = ",".join(f"{weight:g}" for weight in settings.features.weights)
    return ["--modalities", settings.features.text, "--weights", weights]


def as_json(report: Report) -> dict[str, object]:
    """Return the report as ``--json`` writes it."""
    tuning, held_out = report.tuning, report.tuning.held_out
    return {
        "method": report.method,
        "labels": report.truth is not None,
        "conditions": [] if report.unlabelled is None else list(report.unlabelled.conditions),
        "default": _settings(tuning.default),
        "tuned": _settings(tuning.tuned),
        "recommended": _settings(report.recommended) | {"tuned": tuning.is_better},
        "held_out": {
            "default": asdict(held_out.default),
            "tuned": asdict(held_out.tuned),
            "difference": asdict(held_out.difference),
            "chosen": [_settings(one) for one in held_out.chosen],
        },
        "precision": report.precision,
        "threshold": None if tuning.threshold is None else asdict(tuning.threshold),
        "held_out_answers": None if tuning.held_out_answers is None else asdict(tuning.held_out_answers),
        "lambda1": None if report.lambdas is None else report.lambdas[0],
        "lambda2": None if report.lambdas is None else report.lambdas[1],
        "alone": [_tried(one) for one in tuning.alone],
        "tried": [_tried(one) for one in tuning.tried],
        "match_command": report.match_command,
        "learn_command": report.learn_command,
        "seconds": {stage: round(seconds, 3) for stage, seconds in report.seconds.items()},
    }


def _settings(settings: MatchSettings) -> dict[str, object]:
    return {
        "modalities": list(settings.features.modalities),
        "weights": list(settings.features.weights),
        "length": settings.length,
        "penalty": settings.penalty,
    }


def _tried(one: Tried) -> dict[str, object]:
    return _settings(one.settings) | {"auc": one.auc}


def as_text(report: Report, written: Path | None) -> Iterator[str]:
    """Yield the lines that are printed; `written` is the file of results."""
    tuning, held_out = report.tuning, report.tuning.held_out
    yield from _about(report)
    yield ""
    alone = sorted(tuning.alone, key=lambda one: -one.auc)
    yield from table(
        [["modality alone", "AUC"], *([described_by(one.settings.features), f"{one.auc:.3f}"] for one in alone)]
    )
    yield ""
    yield from _settings_tried(report, written)
    yield ""
    rows = {
        f"held-out AUC, {report.start}": _figure(held_out.default),
        "held-out AUC, tuned": _figure(held_out.tuned),
        f"tuned minus {report.start}": _figure(held_out.difference),
        "recommended": _verdict(tuning, report.start),
    }
    rows |= _about_tau(report)
    if report.lambdas is not None:
        rows["lambda1, lambda2"] = f"{report.lambdas[0]:.4g}, {report.lambdas[1]:.4g}"
    rows["seconds"] = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in report.seconds.items())
    if written is not None:
        rows["written"] = str(written)
    yield from _columns(rows)
    yield ""
    yield report.match_command
    if report.learn_command is not None:
        yield report.learn_command


def _about(report: Report) -> Iterator[str]:
    if report.unlabelled is None:
        yield from _columns({"method": report.method, "labels": f"{report.truth}, of {report.queries}"})
        return
    yield from _columns(
        {
            "method": report.method,
            "labels": f"none; every second frame of {report.references} is a query against the others,",
            "": "alone and under other conditions, which stand for another traverse:",
        }
    )
    for line in report.unlabelled.conditions:
        yield from textwrap.wrap(line, _WIDTH, initial_indent="  ", subsequent_indent="    ")


def _columns(rows: dict[str, str]) -> Iterator[str]:
    width = max(map(len, rows)) + 2
    yield from (f"{name:{width}}{value}" for name, value in rows.items())


def _settings_tried(report: Report, written: Path | None) -> Iterator[str]:
    tuning = report.tuning
    rows = [["settings tried on all queries, best first", "", "l", "penalty", "AUC"]]
    places = range(len(tuning.tried))
    default = next(place for place in places if tuning.tried[place].settings == tuning.default)
    for place in sorted({*places[:_SHOWN], default}):
        one = tuning.tried[place]
        penalty = "-" if one.settings.penalty is None else f"{one.settings.penalty:g}"
        mark = report.start if place == default else ""
        length = one.settings.length
        rows.append([described_by(one.settings.features), mark, str(length), penalty, f"{one.auc:.3f}"])
    yield from table(rows, left=2)
    if len(tuning.tried) > len(rows) - 1:
        more = "--json FILE writes all" if written is None else f"all are in {written}"
        yield f"{len(rows) - 1} of {len(tuning.tried)} settings; {more}"


def _figure(figure: Figure) -> str:
    low, high = figure.interval
    return f"{figure.value:.3f} (95 % interval {low:.3f} to {high:.3f})"


def _verdict(tuning: Tuning, start: str) -> str:
    if tuning.is_better:
        return f"the tuned settings: better than {start} on queries that did not choose them"
    if tuning.tuned == tuning.default:
        return f"{start}: nothing that was tried is better"
    return f"{start}: on queries that did not choose, the tuned settings are not better by more than chance"


def _about_tau(report: Report) -> dict[str, str]:
    """Say what a threshold would do, on held-out queries first: the others have chosen it."""
    threshold, answers = report.tuning.threshold, report.tuning.held_out_answers
    if threshold is None:
        return {"tau": f"none: no threshold gives a precision of {report.precision:g}"}
    rows = {"tau": f"--tau {threshold.tau!r} leaves out what is not sure"}
    if answers is not None:
        rows["  held out"] = f"{answers.right} of {answers.given} answers right, {answers.findable} to find"
    where = "where it was chosen"
    if report.unlabelled is not None:
        where = f"by windows of {report.unlabelled.length}, a third of the places unknown"
    rows["  chosen"] = f"precision {threshold.precision:.3f}, recall {threshold.recall:.3f} {where}"
    return rows
