"""From what the units found out to the figures of the report: curves, areas, success rates, comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from services.commands.evaluation.plan import DEFAULT_LENGTH, PEERS, Recogniser, WorldPlan
from services.commands.evaluation.results import Finding
from services.commands.evaluation.units import Unit
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, block_length, bootstrap, intervals_of
from smal.evaluation.success import wilson_interval

Findings = Mapping[str, Finding]
#: The peers of the method at its defaults, with the single image among them.
PEERS_OF_DEFAULT: Final = (("smal", 1), *((peer, DEFAULT_LENGTH) for peer in PEERS))
_CERTAIN: Final = 0.05


@dataclass(frozen=True, eq=False)
class Recognised:
    """How well one method recognises in one world, by one criterion.

    Attributes
    ----------
    recogniser, degradation
        Who, and what it saw.
    judgement
        Of all held-out drives, one after another.
    curve, auc_95, recall_95
        Precision over recall; 95 % intervals of its area and of its recall at 100 % precision.
    areas
        The areas of the bootstrap's draws, which are paired between methods.
    operating
        (recall, precision) of the answers that the method's own novelty test lets pass; None if it has none.
    """

    recogniser: Recogniser
    degradation: str
    judgement: Judgement
    curve: PrecisionRecall
    auc_95: tuple[float, float]
    recall_95: tuple[float, float]
    areas: NDArray[np.float64]
    operating: tuple[float, float] | None

    @property
    def name(self) -> str:
        """For people."""
        return recogniser_name(self.recogniser)


@dataclass(frozen=True)
class Success:
    """How often one way to drive found the victim: outcomes by seed."""

    controller: str
    length: int
    degradation: str
    outcomes: Mapping[int, str]
    ticks: Mapping[int, int]

    @property
    def found(self) -> int:
        """Number of searches that found the victim."""
        return sum(outcome == "found" for outcome in self.outcomes.values())

    @property
    def runs(self) -> int:
        """Number of searches."""
        return len(self.outcomes)

    @property
    def rate(self) -> float:
        """Share of searches that found the victim."""
        return self.found / self.runs

    @property
    def wilson_95(self) -> tuple[float, float]:
        """Wilson's interval of the rate."""
        return wilson_interval(self.found, self.runs)

    @property
    def median_ticks(self) -> float | None:
        """Frames until the victim was found, of the searches that found it."""
        ticks = [self.ticks[seed] for seed, outcome in self.outcomes.items() if outcome == "found"]
        return float(np.median(ticks)) if ticks else None


@dataclass(frozen=True)
class Results:
    """What the report shows of one world: who recognised, by each criterion; who searched; the objective."""

    world: WorldPlan
    recognised: list[list[Recognised]]
    successes: list[Success]
    objective: Finding | None


@dataclass(frozen=True)
class Comparison:
    """What the report says in words: mostly SMAL at its defaults against a peer.

    Attributes
    ----------
    verdict
        "ahead" or "behind" where the difference is more than chance (95 %), otherwise "open"; "counts" where nothing is
        tested.
    text
        One sentence with its numbers.
    """

    world: str
    verdict: Literal["ahead", "behind", "open", "counts"]
    text: str


def recogniser_name(recogniser: Recogniser) -> str:
    """Name a recogniser for people."""
    if recogniser.name == "smal":
        return "single image (l = 1)" if recogniser.length == 1 else f"SMAL, l = {recogniser.length}"
    if recogniser.name == "seqslam":
        return f"SeqSLAM, {recogniser.length} frames"
    return "nearest frame" if recogniser.length == 1 else f"nearest {recogniser.length} frames"


def controller_name(controller: str, length: int) -> str:
    """Name a way to drive for people."""
    if controller == "smal":
        return "single image, same decisions" if length == 1 else f"SMAL, l = {length}"
    names = {
        "nearest-1": "imitating the nearest frame",
        "nearest-5": "imitating the nearest 5 frames",
        "seqslam": "SeqSLAM, same policy",
        "cloning": "behaviour cloning",
    }
    return names.get(controller, f"{controller}, l = {length}")


def results_of(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> Results:
    """Put together what was found out in a world."""
    objective = [findings[unit.key] for unit in units if unit.kind == "objective" and unit.world == world.world]
    judged = [recognised(world, units, findings, number) for number in range(len(world.criteria))]
    return Results(world, judged, successes(world, units, findings), objective[0] if objective else None)


def recognised(world: WorldPlan, units: Sequence[Unit], findings: Findings, criterion: int = 0) -> list[Recognised]:
    """Judge every method of a world under every degradation, by one of the criteria."""
    found = []
    for degradation in world.recognised:
        for recogniser in world.recognisers:
            parts = [
                findings[unit.key]
                for unit in units
                if unit.kind == "recognise"
                and (unit.world, unit["method"], unit["length"], unit["degradation"])
                == (world.world, recogniser.name, recogniser.length, degradation)
            ]
            if parts:
                found.append(_recognised(recogniser, degradation, parts, criterion))
    return found


def _recognised(recogniser: Recogniser, degradation: str, parts: list[Finding], criterion: int) -> Recognised:
    judgement = _joined(parts, criterion)
    curve = PrecisionRecall.of(judgement)
    draws = bootstrap(judgement, block_of(judgement))
    intervals = intervals_of(draws)
    operating = None
    if recogniser.name == "smal":
        known = _all(parts, "known").astype(bool)
        right = int((judgement.right & known).sum())
        if known.any():
            operating = (right / int(judgement.findable.sum()), right / int(known.sum()))
    return Recognised(
        recogniser,
        degradation,
        judgement,
        curve,
        intervals.auc,
        intervals.recall_at_100_precision,
        draws[:, 0],
        operating,
    )


def _joined(parts: list[Finding], criterion: int) -> Judgement:
    score = _all(parts, "score").astype(np.float64)
    answered = _all(parts, "answered").astype(bool)
    right, findable = (np.concatenate([np.array(part[name][criterion]) for part in parts]).astype(bool)
                       for name in ("right", "findable"))  # fmt: skip
    return Judgement(score, answered, right, np.ones(score.size, dtype=np.bool_), findable)


def _all(parts: list[Finding], name: str) -> NDArray[Any]:
    return np.concatenate([np.array(part[name]) for part in parts])


def block_of(judgement: Judgement) -> int:
    """Return how many successive queries the bootstrap keeps together: the same for all methods, to pair them."""
    return block_length(judgement.score.size, 40)


def successes(world: WorldPlan, units: Sequence[Unit], findings: Findings) -> list[Success]:
    """Count the searches of a world, by who drove and what the robot saw."""
    groups: dict[tuple[str, int, str], list[Unit]] = {}
    for unit in units:
        if unit.kind == "search" and unit.world == world.world:
            key = (unit.text("controller"), unit.number("length"), unit.text("degradation"))
            groups.setdefault(key, []).append(unit)
    return [
        Success(
            *key,
            {unit.number("seed"): str(findings[unit.key]["outcome"]) for unit in group},
            {unit.number("seed"): int(findings[unit.key]["ticks"]) for unit in group},
        )
        for key, group in groups.items()
    ]


def success_of(found: Iterable[Success], controller: str, length: int, degradation: str) -> Success | None:
    """Return one of the counts, if it was made."""
    wanted = (controller, length, degradation)
    return next((one for one in found if (one.controller, one.length, one.degradation) == wanted), None)


def compare_recognition(world: str, found: Sequence[Recognised]) -> list[Comparison]:
    """Compare the areas under the curves: SMAL at its default length against every other method."""
    compared = []
    for ours in found:
        if (ours.recogniser.name, ours.recogniser.length) != ("smal", DEFAULT_LENGTH):
            continue
        for peer in found:
            if peer.degradation != ours.degradation or (peer.recogniser.name == "smal" and peer.recogniser.length != 1):
                continue
            low, high = np.nanpercentile(ours.areas - peer.areas, [2.5, 97.5])
            verdict: Literal["ahead", "behind", "open"] = "ahead" if low > 0.0 else "behind" if high < 0.0 else "open"
            text = (
                f"recognition, {ours.degradation}: area {ours.curve.auc:.3f} of {ours.name} against "
                f"{peer.curve.auc:.3f} of {peer.name}, {_said(verdict)} "
                f"(difference {low:+.3f} to {high:+.3f})"
            )
            compared.append(Comparison(world, verdict, text))
    return compared


def compare_searches(world: str, found: Sequence[Success]) -> list[Comparison]:
    """Compare success on the same seeds: SMAL at its defaults against every peer, by the exact sign test."""
    compared = []
    for ours in found:
        if (ours.controller, ours.length) != ("smal", DEFAULT_LENGTH):
            continue
        for controller, length in PEERS_OF_DEFAULT:
            peer = success_of(found, controller, length, ours.degradation)
            if peer is None:
                continue
            verdict, chance = _sign_test(ours, peer)
            text = (
                f"searches, {ours.degradation}: {ours.found} of {ours.runs} found by "
                f"{controller_name(ours.controller, ours.length)} against {peer.found} of {peer.runs} by "
                f"{controller_name(controller, length)}, {_said(verdict)} (p = {chance:.2g})"
            )
            compared.append(Comparison(world, verdict, text))
    return compared


def _sign_test(ours: Success, peer: Success) -> tuple[Literal["ahead", "behind", "open"], float]:
    seeds = ours.outcomes.keys() & peer.outcomes.keys()
    pairs = [(ours.outcomes[seed] == "found", peer.outcomes[seed] == "found") for seed in seeds]
    wins, losses = pairs.count((True, False)), pairs.count((False, True))
    if wins == losses:
        return "open", 1.0
    chance = float(binomtest(wins, wins + losses).pvalue)
    if chance >= _CERTAIN:
        return "open", chance
    return ("ahead" if wins > losses else "behind"), chance


def _said(verdict: str) -> str:
    return {
        "ahead": "SMAL is ahead",
        "behind": "SMAL is behind",
        "open": "the difference may be chance",
    }[verdict]


def long_sequences(world: str, found: Sequence[Success]) -> list[Comparison]:
    """Say for every scheme and degradation whether the longest sequences succeed as often as the best length."""
    said = []
    for controller, degradation in dict.fromkeys((one.controller, one.degradation) for one in found):
        if controller in PEERS:
            continue
        each = sorted(
            (one for one in found if (one.controller, one.degradation) == (controller, degradation)),
            key=lambda one: one.length,
        )
        long = [one for one in each if one.length >= 20]
        if not long or len(each) == len(long):
            continue
        best = max(each, key=lambda one: one.rate)
        as_good = all(one.rate >= best.rate for one in long)
        counts = ", ".join(f"{one.found} of {one.runs} at l = {one.length}" for one in each)
        if not best.found:
            end = "no length finds the victim"
        elif as_good:
            end = "long sequences are as good as the best"
        else:
            end = f"long sequences lose against l = {best.length}"
        said.append(Comparison(world, "counts", f"lengths, {controller}, {degradation}: {counts}; {end}"))
    return said


def as_json(found: Sequence[Results]) -> dict[str, Any]:
    """Return the numbers of all figures."""
    return {
        one.world.world: {
            "recognition": [
                _recognised_json(each, criterion.meaning)
                for criterion, judged in zip(one.world.criteria, one.recognised, strict=True)
                for each in judged
            ],
            "searches": [_success_json(each) for each in one.successes],
            "objective": one.objective and {name: value for name, value in one.objective.items() if name != "cpu_s"},
        }
        for one in found
    }


def _recognised_json(one: Recognised, criterion: str) -> dict[str, Any]:
    curve = one.curve
    return {
        "method": one.recogniser.name,
        "length": one.recogniser.length,
        "degradation": one.degradation,
        "criterion": criterion,
        "queries": int(one.judgement.score.size),
        "findable": int(one.judgement.findable.sum()),
        "auc": curve.auc,
        "auc_95": list(one.auc_95),
        "recall_at_100_precision": curve.recall_at_100_precision,
        "recall_at_100_precision_95": list(one.recall_95),
        "novelty_test": None if one.operating is None else {"recall": one.operating[0], "precision": one.operating[1]},
        "recall": curve.recall.round(5).tolist(),
        "precision": curve.precision.round(5).tolist(),
    }


def _success_json(one: Success) -> dict[str, Any]:
    return {
        "controller": one.controller,
        "length": one.length,
        "degradation": one.degradation,
        "found": one.found,
        "runs": one.runs,
        "success_rate": one.rate,
        "wilson_95": list(one.wilson_95),
        "median_ticks_found": one.median_ticks,
        "outcomes": {str(seed): outcome for seed, outcome in one.outcomes.items()},
    }
