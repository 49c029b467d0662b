"""From what the units found out to the numbers of the report: curves, areas, success rates."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.plan import JUDGED_TICKS, RecognizerName, Trial, WorldPlan
from services.experiments.evaluation.units import Errand, Finding, Recognize, Searches, Unit
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import (
    Intervals,
    PrecisionRecall,
    block_length,
    bootstrap,
    intervals_of,
    wilson_interval,
)

SOON_S: Final = 3.0  # Within which a kidnapped robot should know where it is.


@dataclass(frozen=True, eq=False)
class Recognized:
    """How well one method recognizes in one world, from the frame on at which every method has a whole window."""

    recognizer: RecognizerName
    degradation: str
    judgement: Judgement
    curve: PrecisionRecall
    intervals: Intervals

    def as_json(self, criterion: str) -> dict[str, Any]:
        """Return its numbers."""
        return {
            "method": self.recognizer.title,
            "length": self.recognizer.length,
            "degradation": self.degradation,
            "criterion": criterion,
            "queries": int(self.judgement.score.size),
            "findable": int(self.judgement.findable.sum()),
            "auc": self.curve.auc,
            "auc_95": list(self.intervals.auc),
            "recall_at_100_precision": self.curve.recall_at_100_precision,
            "recall_at_100_precision_95": list(self.intervals.recall_at_100_precision),
            "recall": self.curve.recall.round(5).tolist(),
            "precision": self.curve.precision.round(5).tolist(),
        }


class Success:
    """How well the searches of one trial went; ``as_json`` names every number of it.

    ``spl`` is success weighted by path length (Anderson et al. 2018), None where robots were carried; the expert's
    route counts as shortest: who cuts its corners has 1. Distances from the taught ways are of all frames of all
    searches. ``clearance_p5_m`` is the mean over searches of the 5th percentile over frames of how far the robot's side
    was from the nearest thing or person; ``turns_per_m`` how often it began to turn, over metres driven; ``jerk_m_s3``
    the root mean square jerk of all searches; ``time_over_taught`` how long those that found took, over the mean taught
    drive, None where they began elsewhere or none found. Interventions are searches that a person would have had to
    end or to correct (all but those that found, or rightly said "not here"), a kilometre driven. ``wrong_share`` is of
    frames: sure, and elsewhere; ``right_soon`` in how many searches, of how many, it was right `SOON_S` after it was
    carried away.
    """

    def __init__(self, trial: Trial, searches: Sequence[Finding]) -> None:
        self.trial = trial
        self.searches = searches
        self.outcomes = [str(one["outcome"]) for one in searches]
        self.found = self.outcomes.count("found")
        self.runs = len(searches)
        self.rate = self.found / self.runs
        self.wilson_95 = wilson_interval(self.found, self.runs)
        failed = sum(one["outcome"] != "found" and one["right"] is not True for one in searches)
        self.spl = self._spl()
        self.aside_rms_m = self._rms("aside_rms_m")
        self.aside_max_m = float(self._of("aside_max_m").max())
        self.clearance_p5_m = float(self._of("clearance_p5_m").mean())
        self.turns_per_m = self._per_m(self._of("turns").sum())
        self.jerk_m_s3 = self._rms("jerk_m_s3")
        self.time_over_taught = self._time_over_taught()
        self.interventions_per_km = self._per_m(1e3 * failed)
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
        if self.trial.kidnap_tick:
            return None
        shortest = self._of("shortest_m")
        longest = np.maximum(self._of("driven_m"), shortest)
        found = np.array(self.outcomes) == "found"
        return float((found * shortest / np.maximum(longest, 1e-9)).mean())

    def _time_over_taught(self) -> float | None:
        if not self.found or self.trial.kidnap_tick or self.trial.start != "start":
            return None
        ratio = self._of("ticks") / self._of("taught_ticks")
        return float(ratio[np.array(self.outcomes) == "found"].mean())

    def _wrong_share(self) -> float | None:
        if "wrong_share" not in self.searches[0]:
            return None
        return float(np.average(self._of("wrong_share"), weights=self._of("ticks")))

    def _right_soon(self) -> tuple[int, int] | None:
        times = [one["right_after_s"] for one in self.searches if "right_after_s" in one]
        soon = sum(time is not None and time <= SOON_S for time in times)
        return (soon, len(times)) if times else None

    def as_json(self) -> dict[str, Any]:
        """Return its numbers."""
        own = {
            name: value for name, value in vars(self).items() if name not in ("trial", "searches")
        }
        return (
            asdict(self.trial)
            | {"condition": self.trial.condition, "success_rate": self.rate}
            | own
        )


@dataclass(frozen=True)
class WorldResults:
    """What the report shows of one world: who recognized; who searched; errands."""

    world: WorldPlan
    recognized: list[Recognized]
    successes: list[Success]
    errands: Mapping[str, Finding]

    @property
    def by_condition(self) -> list[Success]:
        """The searches as taught by their number of drives, then the others by condition."""

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
            "errands": self.errands,
        }


def results_of(
    world: WorldPlan, units: Iterable[Unit], findings: Mapping[Unit, Finding]
) -> WorldResults:
    """Put together what was found out in a world."""
    here = [
        (unit, findings[unit])
        for unit in units
        if unit in findings and unit.site.world == world.world
    ]
    searches: dict[Trial, list[Finding]] = {}
    for unit, one in here:
        if isinstance(unit, Searches):
            searches.setdefault(unit.trial, []).extend(one["searches"])
    return WorldResults(
        world,
        [
            recognized(world, unit.recognizer, unit.degradation, found["queries"])
            for unit, found in here
            if isinstance(unit, Recognize)
        ],
        [Success(trial, found) for trial, found in searches.items()],
        {unit.errand: found for unit, found in here if isinstance(unit, Errand)},
    )


def recognized(
    world: WorldPlan, recognizer: RecognizerName, degradation: str, parts: Sequence[Finding]
) -> Recognized:
    """Judge one method by what was found out of each held-out drive."""
    names = "tick", "score", "answered", "right", "findable"
    tick, score, *flags = (np.concatenate([part[name] for part in parts]) for name in names)
    late = tick >= world.first_judged_tick
    answered, right, findable = (each[late].astype(bool) for each in flags)
    judgement = Judgement(score[late].astype(float), answered, right, np.ones_like(right), findable)
    block = block_length(judgement.score.size, -(-(world.first_judged_tick + 1) // JUDGED_TICKS))
    curve = PrecisionRecall.of(judgement)
    intervals = intervals_of(bootstrap(judgement, block))
    return Recognized(recognizer, degradation, judgement, curve, intervals)
