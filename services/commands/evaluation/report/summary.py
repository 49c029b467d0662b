"""From what the units found out to the numbers of the report: curves, areas, success rates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.commands.evaluation.plan import DEFAULT_LENGTH, JUDGED_TICKS, PEERS, SCHEMES, Recogniser, WorldPlan
from services.commands.evaluation.results import Finding
from services.commands.evaluation.units import Unit
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, block_length, bootstrap, intervals_of
from smal.evaluation.success import wilson_interval

Findings = Mapping[str, Finding]
#: Whom the filter is compared with: the paper's scheme, by single images too, and the peers.
PEERS_OF_DEFAULT: Final = (("paper", DEFAULT_LENGTH), ("paper", 1), *((peer, DEFAULT_LENGTH) for peer in PEERS))


@dataclass(frozen=True, eq=False)
class Recognised:
    """How well one method recognises in one world, by one criterion.

    Attributes
    ----------
    recogniser, degradation
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

    recogniser: Recogniser
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
    def found_ticks(self) -> list[int]:
        """Frames until the victim was found, of the searches that found it, ascending."""
        return sorted(self.ticks[seed] for seed, outcome in self.outcomes.items() if outcome == "found")

    @property
    def median_ticks(self) -> float | None:
        """Their median."""
        return float(np.median(self.found_ticks)) if self.found else None


@dataclass(frozen=True)
class Results:
    """What the report shows of one world: who recognised, by each criterion; who searched; the objective."""

    world: WorldPlan
    recognised: list[list[Recognised]]
    successes: list[Success]
    objective: Finding | None


def recogniser_name(recogniser: Recogniser) -> str:
    """Name a recogniser for people."""
    if recogniser.name == "smal":
        return "single image (l = 1)" if recogniser.length == 1 else f"Eq. 9, l = {recogniser.length}"
    if recogniser.name == "seqslam":
        return f"SeqSLAM, {recogniser.length} frames"
    return "nearest frame" if recogniser.length == 1 else f"nearest {recogniser.length} frames"


def controller_name(controller: str, length: int) -> str:
    """Name a way to drive for people."""
    if controller == "paper":
        return f"the paper's scheme, l = {length}"
    return {
        "smal": "SMAL",
        "nearest-1": "imitating the nearest frame",
        "nearest-5": "imitating the nearest 5 frames",
        "seqslam": "continuing from where SeqSLAM says",
        "cloning": "behaviour cloning",
    }[controller]


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
                found.append(_recognised(world, recogniser, degradation, parts, criterion))
    return found


def _recognised(
    world: WorldPlan, recogniser: Recogniser, degradation: str, parts: list[Finding], criterion: int
) -> Recognised:
    whole = _joined(parts, criterion)
    late = np.concatenate([_ticks(len(part["score"])) >= world.first_judged_tick for part in parts])
    judgement = _of(whole, late)
    curve = PrecisionRecall.of(judgement)
    draws = bootstrap(judgement, block_of(world, judgement))
    intervals = intervals_of(draws)
    return Recognised(
        recogniser,
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
    """Count the searches of a world, by who drove and what the robot saw; schemes first, by length."""
    groups: dict[tuple[str, int, str], list[Unit]] = {}
    for unit in units:
        if unit.kind == "search" and unit.world == world.world:
            key = (unit.text("controller"), unit.number("length"), unit.text("degradation"))
            groups.setdefault(key, []).append(unit)
    order = [*SCHEMES, *PEERS]
    return [
        Success(
            *key,
            {unit.number("seed"): str(findings[unit.key]["outcome"]) for unit in group},
            {unit.number("seed"): int(findings[unit.key]["ticks"]) for unit in group},
        )
        for key, group in sorted(groups.items(), key=lambda one: (order.index(one[0][0]), one[0][1]))
    ]


def success_of(found: Iterable[Success], controller: str, length: int, degradation: str) -> Success | None:
    """Return one of the counts, if it was made."""
    wanted = (controller, length, degradation)
    return next((one for one in found if (one.controller, one.length, one.degradation) == wanted), None)
