"""From what the units found out to the numbers of the report: curves, areas, success rates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.plan import JUDGED_TICKS, Errand, Recognizer, Trial, WorldPlan
from services.experiments.evaluation.results import Finding
from services.experiments.evaluation.units import Unit, settings_of
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, block_length, bootstrap, intervals_of
from smal.evaluation.success import wilson_interval

Findings = Mapping[Unit, Finding]
#: Within which a kidnapped robot should know where it is.
SOON_S: Final = 3.0


@dataclass(frozen=True, eq=False)
class Recognized:
    """How well one method recognizes in one world, by one criterion.

    The judgement is of all held-out drives from the frame on at which every method has a whole window;
    ``auc_from_start`` is of all frames. ``areas`` are those of the bootstrap's draws, paired between methods.
    """

    recognizer: Recognizer
    degradation: str
    judgement: Judgement
    curve: PrecisionRecall
    auc_95: tuple[float, float]
    auc_from_start: float
    recall_95: tuple[float, float]
    areas: NDArray[np.float64]

    def as_json(self, criterion: str) -> dict[str, Any]:
        """Return its numbers."""
        return {
            "method": self.recognizer.name,
            "length": self.recognizer.length,
            "degradation": self.degradation,
            "criterion": criterion,
            "queries": int(self.judgement.score.size),
            "findable": int(self.judgement.findable.sum()),
            "auc": self.curve.auc,
            "auc_95": list(self.auc_95),
            "auc_from_start": self.auc_from_start,
            "recall_at_100_precision": self.curve.recall_at_100_precision,
            "recall_at_100_precision_95": list(self.recall_95),
            "recall": self.curve.recall.round(5).tolist(),
            "precision": self.curve.precision.round(5).tolist(),
        }


@dataclass(frozen=True, eq=False)
class Success:
    """How well one trial's searches went: what was found out, by seed."""

    trial: Trial
    findings: Mapping[int, Finding]

    @property
    def found(self) -> int:
        """Number of searches that found the victim."""
        return self.ended("found")

    def ended(self, outcome: str) -> int:
        """Return the number of searches that ended so."""
        return sum(one["outcome"] == outcome for one in self.findings.values())

    @property
    def runs(self) -> int:
        """Number of searches."""
        return len(self.findings)

    @property
    def said(self) -> str:
        """For people."""
        return f"{self.found} of {self.runs}"

    @property
    def rate(self) -> float:
        """Share of searches that found the victim."""
        return self.found / self.runs

    @property
    def wilson_95(self) -> tuple[float, float]:
        """Wilson's interval of the rate."""
        return wilson_interval(self.found, self.runs)

    @property
    def spl(self) -> float | None:
        """Success weighted by path length (Anderson et al. 2018); None where robots were carried, not driven.

        The way that counts as shortest is the expert's route along the lanes: who cuts its corners has 1.
        """
        if self.trial.kidnap_tick:
            return None
        shares = [
            (one["outcome"] == "found") * one["shortest_m"] / max(one["driven_m"], one["shortest_m"], 1e-9)
            for one in self.findings.values()
        ]
        return float(np.mean(shares))

    @property
    def aside_rms_m(self) -> float:
        """Distance from the taught ways, root of the mean square over all frames of all searches, metres."""
        frames = [one["ticks"] + 1 for one in self.findings.values()]
        squares = [one["aside_rms_m"] ** 2 for one in self.findings.values()]
        return float(np.sqrt(np.average(squares, weights=frames)))

    @property
    def aside_max_m(self) -> float:
        """Largest distance from the taught ways, metres."""
        return max(float(one["aside_max_m"]) for one in self.findings.values())

    @property
    def interventions_per_km(self) -> float | None:
        """Searches in which a person would have had to step in, over the way that was driven; None without any way."""
        driven_m = sum(float(one["driven_m"]) for one in self.findings.values())
        return 1000.0 * (self.runs - self.found) / driven_m if driven_m > 1.0 else None

    @property
    def wrong_share(self) -> float | None:
        """Share of frames at which the robot believed to be elsewhere, and not to be lost; None if it says nothing."""
        told = [one for one in self.findings.values() if "wrong_share" in one]
        shares, frames = ([one[name] for one in told] for name in ("wrong_share", "ticks"))
        return float(np.average(shares, weights=frames)) if told else None

    @property
    def right_soon(self) -> tuple[int, int] | None:
        """In how many searches the belief was right `SOON_S` after being carried away, and of how many."""
        times = [one["right_after_s"] for one in self.findings.values() if "right_after_s" in one]
        return (sum(time is not None and time <= SOON_S for time in times), len(times)) if times else None

    def as_json(self) -> dict[str, Any]:
        """Return its numbers."""
        names = (
            "found",
            "runs",
            "wilson_95",
            "spl",
            "aside_rms_m",
            "aside_max_m",
            "interventions_per_km",
            "wrong_share",
        )
        return {
            **dict(settings_of(self.trial)),
            "condition": self.trial.condition,
            "success_rate": self.rate,
            **{name: getattr(self, name) for name in names},
            "right_within_3_s": self.right_soon,
            "outcomes": {str(seed): one["outcome"] for seed, one in self.findings.items()},
        }


@dataclass(frozen=True)
class WorldResults:
    """What the report shows of one world: who recognized, by each criterion; who searched; errands; the objective."""

    world: WorldPlan
    recognized: list[list[Recognized]]
    successes: list[Success]
    objective: Finding | None
    errands: Mapping[Errand, Finding]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers of all figures."""
        pairs = zip(self.world.criteria, self.recognized, strict=True)
        return {
            "recognition": [one.as_json(criterion.meaning) for criterion, judged in pairs for one in judged],
            "searches": [one.as_json() for one in self.successes],
            "errands": {name: _timeless(one) for name, one in self.errands.items()},
            "objective": self.objective and _timeless(self.objective),
        }


def _timeless(found: Finding) -> dict[str, Any]:
    return {name: value for name, value in found.items() if name != "cpu_s"}


def results_of(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> WorldResults:
    """Put together what was found out in a world."""
    here = [unit for unit in units if unit["world"] == world.world]
    objective = [findings[unit] for unit in here if unit.kind == "objective"]
    errands = {unit["errand"]: findings[unit] for unit in here if unit.kind == "errand"}
    judged = [list(_recognized(world, here, findings, number)) for number in range(len(world.criteria))]
    return WorldResults(world, judged, _successes(world, here, findings), objective[0] if objective else None, errands)


def _recognized(world: WorldPlan, units: Sequence[Unit], findings: Findings, criterion: int) -> Iterator[Recognized]:
    """Judge every method of a world under every degradation, by one of the criteria."""
    for degradation in world.recognized:
        for recognizer in world.recognizers:
            asked = (recognizer.name, recognizer.length, degradation)
            parts = [findings[unit] for unit in units if unit.kind == "recognize"
                     and (unit["method"], unit["length"], unit["degradation"]) == asked]  # fmt: skip
            if parts:
                yield recognized(world, recognizer, degradation, parts, criterion)


def recognized(
    world: WorldPlan, recognizer: Recognizer, degradation: str, parts: Sequence[Finding], criterion: int
) -> Recognized:
    """Judge one method by what was found out of each held-out drive."""
    score, answered = (np.concatenate([part[name] for part in parts]) for name in ("score", "answered"))
    right, findable = (np.concatenate([part[name][criterion] for part in parts]) for name in ("right", "findable"))
    everything = np.ones(score.size, dtype=np.bool_)
    whole = Judgement(score.astype(float), answered.astype(bool), right.astype(bool), everything, findable.astype(bool))
    # A query is judged at this frame of its drive; from the first one on every method has a whole window.
    ticks = np.concatenate([JUDGED_TICKS * (np.arange(len(part["score"])) + 1) - 1 for part in parts])
    late = ticks >= world.first_judged_tick
    judgement = Judgement(*(getattr(whole, each.name)[late] for each in fields(whole)))
    # The same blocks for all methods, to pair them.
    block = block_length(judgement.score.size, -(-(world.first_judged_tick + 1) // JUDGED_TICKS))
    draws = bootstrap(judgement, block)
    intervals = intervals_of(draws)
    return Recognized(
        recognizer, degradation, judgement, PrecisionRecall.of(judgement), intervals.auc, PrecisionRecall.of(whole).auc,
        intervals.recall_at_100_precision, draws[:, 0],
    )  # fmt: skip


def _successes(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> list[Success]:
    """Put together the searches of a world, by trial and in the order of the plan."""
    found = []
    for trial in world.trials:
        settings = set(settings_of(trial))
        own = {unit["seed"]: findings[unit] for unit in units
               if unit.kind == "search" and settings.issubset(unit.settings)}  # fmt: skip
        if own:
            found.append(Success(trial, own))
    return found


def success_of(found: Iterable[Success], trial: Trial) -> Success | None:
    """Return what came out of a trial, whatever its number of runs, if it was made."""
    return next((one for one in found if settings_of(one.trial) == settings_of(trial)), None)
