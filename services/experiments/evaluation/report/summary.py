"""From what the units found out to the numbers of the report: curves, areas, success rates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.plan import JUDGED_TICKS, Errand, Recognizer, Trial, WorldPlan
from services.experiments.evaluation.results import Finding
from services.experiments.evaluation.schedule import Settings, Unit, settings_of
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, block_length, bootstrap, intervals_of
from smal.evaluation.success import wilson_interval

Findings = Mapping[str, Finding]


@dataclass(frozen=True, eq=False)
class Recognized:
    """How well one method recognizes in one world, by one criterion.

    Attributes
    ----------
    recognizer, degradation
        Who, and what it saw.
    judgement
        Of all held-out drives, one after another, from the frame on at which every method has a whole window.
    curve, auc_95, recall_95
        Precision over recall; 95 % intervals of its area and of its recall at 100 % precision.
    auc_from_start
        The area over all judged frames, with those before the first whole window.
    areas
        The areas of the bootstrap's draws, which are paired between methods.
    """

    recognizer: Recognizer
    degradation: str
    judgement: Judgement
    curve: PrecisionRecall
    auc_95: tuple[float, float]
    auc_from_start: float
    recall_95: tuple[float, float]
    areas: NDArray[np.float64]

    @property
    def name(self) -> str:
        """For people."""
        return recognizer_name(self.recognizer)


@dataclass(frozen=True, eq=False)
class Success:
    """How well one trial's searches went: what was found out, by seed."""

    trial: Trial
    findings: Mapping[int, Finding]

    @property
    def name(self) -> str:
        """Who drove, for people."""
        return controller_name(self.trial.controller, self.trial.length)

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

    def right_within(self, seconds: float) -> tuple[int, int] | None:
        """Return in how many searches the belief was right so soon after being carried away, and of how many."""
        times = [one["right_after_s"] for one in self.findings.values() if "right_after_s" in one]
        return (sum(time is not None and time <= seconds for time in times), len(times)) if times else None


@dataclass(frozen=True)
class Results:
    """What the report shows of one world: who recognized, by each criterion; who searched; errands; the objective."""

    world: WorldPlan
    recognized: list[list[Recognized]]
    successes: list[Success]
    objective: Finding | None
    errands: Mapping[Errand, Finding]


def recognizer_name(recognizer: Recognizer) -> str:
    """Name a recognizer for people."""
    if recognizer.name == "smal":
        return "single image (l = 1)" if recognizer.length == 1 else f"Eq. 9, l = {recognizer.length}"
    if recognizer.name == "seqslam":
        return f"SeqSLAM, {recognizer.length} frames"
    return "nearest frame" if recognizer.length == 1 else f"nearest {recognizer.length} frames"


def controller_name(controller: str, length: int) -> str:
    """Name who searches for people."""
    if controller == "paper":
        return f"the paper's scheme, l = {length}"
    return {
        "smal": "SMAL",
        "teach-and-repeat": "teach and repeat",
        "nearest-1": "imitating the nearest frame",
        "nearest-5": "imitating the nearest 5 frames",
        "seqslam": "continuing from where SeqSLAM says",
    }[controller]


def results_of(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> Results:
    """Put together what was found out in a world."""
    objective = [findings[unit.key] for unit in units if unit.kind == "objective" and unit.world == world.world]
    judged = [recognized(world, units, findings, number) for number in range(len(world.criteria))]
    errands = {
        errand: findings[unit.key]
        for errand in world.errands
        for unit in units
        if (unit.kind, unit.world) == ("errand", world.world) and unit["errand"] == errand
    }
    return Results(world, judged, successes(world, units, findings), objective[0] if objective else None, errands)


def recognized(world: WorldPlan, units: Sequence[Unit], findings: Findings, criterion: int = 0) -> list[Recognized]:
    """Judge every method of a world under every degradation, by one of the criteria."""
    found = []
    for degradation in world.recognized:
        for recognizer in world.recognizers:
            parts = [
                findings[unit.key]
                for unit in units
                if unit.kind == "recognize"
                and (unit.world, unit["method"], unit["length"], unit["degradation"])
                == (world.world, recognizer.name, recognizer.length, degradation)
            ]
            if parts:
                found.append(_recognized(world, recognizer, degradation, parts, criterion))
    return found


def _recognized(
    world: WorldPlan, recognizer: Recognizer, degradation: str, parts: list[Finding], criterion: int
) -> Recognized:
    whole = _joined(parts, criterion)
    late = np.concatenate([_ticks(len(part["score"])) >= world.first_judged_tick for part in parts])
    judgement = _of(whole, late)
    curve = PrecisionRecall.of(judgement)
    draws = bootstrap(judgement, block_of(world, judgement))
    intervals = intervals_of(draws)
    return Recognized(
        recognizer,
        degradation,
        judgement,
        curve,
        intervals.auc,
        PrecisionRecall.of(whole).auc,
        intervals.recall_at_100_precision,
        draws[:, 0],
    )


def _joined(parts: list[Finding], criterion: int) -> Judgement:
    score = _all(parts, "score").astype(np.float64)
    answered = _all(parts, "answered").astype(bool)
    right, findable = (np.concatenate([np.array(part[name][criterion]) for part in parts]).astype(bool)
                       for name in ("right", "findable"))  # fmt: skip
    return Judgement(score, answered, right, np.ones(score.size, dtype=np.bool_), findable)


def _ticks(queries: int) -> NDArray[np.int64]:
    """Return at which frames of its drive the queries were judged."""
    return JUDGED_TICKS * (np.arange(queries) + 1) - 1


def _of(whole: Judgement, queries: NDArray[np.bool_]) -> Judgement:
    return Judgement(*(getattr(whole, each.name)[queries] for each in fields(whole)))


def _all(parts: list[Finding], name: str) -> NDArray[Any]:
    return np.concatenate([np.array(part[name]) for part in parts])


def block_of(world: WorldPlan, judgement: Judgement) -> int:
    """Return how many successive queries the bootstrap keeps together: the same for all methods, to pair them."""
    return block_length(judgement.score.size, -(-(world.first_judged_tick + 1) // JUDGED_TICKS))


def successes(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> list[Success]:
    """Put together the searches of a world, by trial and in the order of the plan."""
    groups: dict[Settings, dict[int, Finding]] = {}
    for unit in units:
        if unit.kind == "search" and unit.world == world.world:
            trial = tuple(one for one in unit.settings if one[0] not in {"camera", "patience", "seed"})
            groups.setdefault(trial, {})[unit.number("seed")] = findings[unit.key]
    each = ((trial, groups.get(settings_of(trial))) for trial in world.trials)
    return [Success(trial, found) for trial, found in each if found]


def success_of(found: Iterable[Success], trial: Trial) -> Success | None:
    """Return what came out of a trial, whatever its number of runs, if it was made."""
    return next((one for one in found if settings_of(one.trial) == settings_of(trial)), None)
