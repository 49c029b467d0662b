"""Numbers of the report from the results of the units: curves, areas, success rates."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.plan import (
    CELLS,
    JUDGED_TICKS,
    RecognizerName,
    Trial,
    WorldPlan,
)
from services.experiments.evaluation.units import Finding, Recognize, Searches, TaskSearches, Unit
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import (
    PrecisionRecall,
    figures_of,
    wilson_interval,
)

SOON_S: Final = 3.0  # Time within which a kidnapped robot should relocalise, seconds.


@dataclass(frozen=True, eq=False)
class Recognized:
    """Recognition of one method in one world, from the first frame with a complete window."""

    recognizer: RecognizerName
    degradation: str
    judgement: Judgement
    curve: PrecisionRecall
    figures: dict[str, float | tuple[float, float]]  # With 95 % intervals, by name.

    def as_json(self, criterion: str) -> dict[str, Any]:
        """Return the numbers."""
        return {
            "method": self.recognizer.title,
            "length": self.recognizer.length,
            "degradation": self.degradation,
            "criterion": criterion,
            "queries": int(self.judgement.score.size),
            "findable": int(self.judgement.findable.sum()),
            **self.figures,
            "recall": self.curve.recall.round(5).tolist(),
            "precision": self.curve.precision.round(5).tolist(),
        }


class Success:
    """Results of the searches of one trial; ``as_json`` returns every number.

    Attributes
    ----------
    spl
        Success weighted by path length (Anderson et al. 2018). The expert's route counts as
        shortest, so a robot that cuts its corners has 1. None for kidnapped robots, and without a
        victim.
    aside_rms_m, aside_max_m
        Distance from the taught ways, over all frames of all searches.
    clearance_p5_m
        Mean over searches of the 5th percentile over frames of the distance from the robot's side
        to the nearest obstacle or person.
    turns_per_m
        Starts of a turn, per metre driven.
    jerk_m_s3
        Root mean square jerk of all searches.
    time_over_taught
        Duration of successful searches over that of the mean taught drive; None for other starts or
        without success.
    interventions_per_km
        Searches that a person would have to end or correct (all but found, and a correct "not
        here"), per kilometre driven.
    wrong_share
        Share of frames with a confident and wrong position; None without any estimate.
    arrival_m
        Median over searches of the distance to the victim, or to its taught place, at the end.
    decision_ms
        Median and 95th percentile of the wall time of a decision.
    right_soon
        Number of searches that relocalise within `SOON_S` after the kidnapping, and number of all.
    """

    def __init__(
        self, trial: Trial, searches: Sequence[Finding], decision_ms: Sequence[float]
    ) -> None:
        self.trial = trial
        self.searches = searches
        self.outcomes = [str(one["outcome"]) for one in searches]
        # A "not here" is right if the victim is absent.
        right = [one["outcome"] == "found" or one["right"] is True for one in searches]
        self.succeeded = sum(right)
        self.runs = len(searches)
        self.rate = self.succeeded / self.runs
        self.wilson_95 = wilson_interval(self.succeeded, self.runs)
        self.spl = self._spl()
        self.aside_rms_m = self._rms("aside_rms_m")
        self.aside_max_m = float(self._of("aside_max_m").max())
        self.clearance_p5_m = float(self._of("clearance_p5_m").mean())
        self.turns_per_m = self._per_m(self._of("turns").sum())
        self.jerk_m_s3 = self._rms("jerk_m_s3")
        self.time_over_taught = self._time_over_taught()
        self.interventions_per_km = self._per_m(1e3 * (self.runs - self.succeeded))
        self.arrival_m = float(np.median(self._of("arrival_m")))
        median_ms, slow_ms = np.quantile(decision_ms, (0.5, 0.95)).round(2).tolist()
        self.decision_ms = (median_ms, slow_ms)
        self.wrong_share = self._wrong_share()
        self.right_soon = self._right_soon()

    def _of(self, name: str) -> NDArray[np.float64]:
        return np.array([one[name] for one in self.searches], dtype=np.float64)

    def _rms(self, name: str) -> float:
        return float(np.sqrt(np.average(self._of(name) ** 2, weights=self._of("ticks") + 1)))

    def _per_m(self, count: float) -> float | None:
        driven_m = self._of("driven_m").sum()
        return float(count / driven_m) if driven_m > 1.0 else None

    def _spl(self) -> float | None:
        if self.trial.kidnap_tick or self.trial.victim == "absent":
            return None
        shortest = self._of("shortest_m")
        longest = np.maximum(self._of("driven_m"), shortest)
        found = np.array(self.outcomes) == "found"
        return float((found * shortest / np.maximum(longest, 1e-9)).mean())

    def _time_over_taught(self) -> float | None:
        found = np.array(self.outcomes) == "found"
        if not found.any() or self.trial.kidnap_tick or self.trial.start != "start":
            return None
        ratio = self._of("ticks") / self._of("taught_ticks")
        return float(ratio[found].mean())

    def _wrong_share(self) -> float | None:
        if not self._of("sure_share").any():
            return None
        return float(np.average(self._of("wrong_share"), weights=self._of("ticks") + 1))

    def _right_soon(self) -> tuple[int, int] | None:
        if self.wrong_share is None:
            return None
        times = [one["right_after_s"] for one in self.searches if "right_after_s" in one]
        soon = sum(time is not None and time <= SOON_S for time in times)
        return (soon, len(times)) if times else None

    def as_json(self) -> dict[str, Any]:
        """Return the numbers."""
        own = {
            name: value for name, value in vars(self).items() if name not in ("trial", "searches")
        }
        return (
            asdict(self.trial)
            | {"cell": self.trial.cell, "length": self.trial.length}
            | {"condition": self.trial.condition, "success_rate": self.rate}
            | own
        )


@dataclass(frozen=True)
class WorldResults:
    """Results of one world: recognition, searches and tasks."""

    world: WorldPlan
    recognized: list[Recognized]
    successes: list[Success]
    tasks: Mapping[str, Finding]

    @property
    def cells(self) -> dict[str, dict[str, Success]]:
        """The searches of each driver in each cell of a comparison: title, then name of the cell."""
        found: dict[str, dict[str, Success]] = {}
        for one in self.successes:
            if (cell := one.trial.cell) is not None:
                found.setdefault(one.trial.title, {})[cell] = one
        return found

    @property
    def cell_names(self) -> list[str]:
        """The cells with a result, in the order of `CELLS`."""
        return [cell for cell in CELLS if any(cell in one for one in self.cells.values())]

    @property
    def meanings(self) -> dict[str, str]:
        """Meaning of each driver, by its title."""
        return {one.trial.title: one.trial.entry.meaning for one in self.successes}

    @property
    def by_condition(self) -> list[Success]:
        """The searches as taught by number of drives, then the others by condition."""

        def order(one: Success) -> tuple[bool, int, str, str]:
            special = one.trial.condition != "as taught"
            names = (one.trial.condition, one.trial.title) if special else ("", "")
            return special, 0 if special else one.trial.drives, *names

        return sorted(self.successes, key=order)

    def as_json(self) -> dict[str, Any]:
        """Return the numbers of all figures."""
        return {
            "recognition": [one.as_json(self.world.criterion.meaning) for one in self.recognized],
            "searches": [one.as_json() for one in self.successes],
            "tasks": self.tasks,
        }


def results_of(
    world: WorldPlan, units: Iterable[Unit], findings: Mapping[Unit, Finding]
) -> WorldResults:
    """Collect the results of a world; trials with missing searches are left out."""
    here = [
        (unit, findings[unit])
        for unit in units
        if unit in findings and unit.site.world == world.world
    ]
    searches: dict[Trial, list[Finding]] = {}
    decision_ms: dict[Trial, list[float]] = {}
    for unit, one in here:
        if isinstance(unit, Searches):
            searches.setdefault(unit.trial, []).extend(one["searches"])
            decision_ms.setdefault(unit.trial, []).extend(one["decision_ms"])
    return WorldResults(
        world,
        [
            recognized(world, unit.recognizer, unit.degradation, found["queries"])
            for unit, found in here
            if isinstance(unit, Recognize)
        ],
        [
            Success(trial, found, decision_ms[trial])
            for trial, found in searches.items()
            if len(found) == trial.runs
        ],
        {unit.task: found for unit, found in here if isinstance(unit, TaskSearches)},
    )


def recognized(
    world: WorldPlan, recognizer: RecognizerName, degradation: str, parts: Sequence[Finding]
) -> Recognized:
    """Evaluate one method by the results of each held-out drive."""
    names = "tick", "score", "answered", "right", "findable"
    tick, score, *flags = (np.concatenate([part[name] for part in parts]) for name in names)
    late = tick >= world.first_judged_tick
    answered, right, findable = (each[late].astype(bool) for each in flags)
    judgement = Judgement(score[late].astype(float), answered, right, np.ones_like(right), findable)
    curve = PrecisionRecall.of(judgement)
    figures = figures_of(curve, judgement, -(-(world.first_judged_tick + 1) // JUDGED_TICKS))
    return Recognized(recognizer, degradation, judgement, curve, figures)
