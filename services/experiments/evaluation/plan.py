"""Contents of an evaluation as data: `QUICK` and `FULL`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

from schemas.episode import Victim
from schemas.rpc import Start
from services.experiments.evaluation.drivers import (
    DEFAULT_LENGTH,
    LENGTHS,
    DriverEntry,
    driver_entry,
)
from services.experiments.words import condition
from services.kit.errors import UsageError
from services.simulator.opening import BaseKind

#: First seed of taught drives, as in the README; the seeds of queries are beyond all of them.
TEACHING_SEED = 1
QUERY_SEED = 1000
RUN_SEED = 1
CLOUDS_SEED = 100
JUDGED_TICKS: Final = 4  # Distance of judged frames: ten per second show nearly the same.
#: Number of searches of SMAL and of its best baseline, and of tasks; and number of sets of drives
#: after one drive, each of which teaches alone.
RUNS = 10
TAUGHT = 5
# Variants of SMAL to compare when there are obstacles.
_PARTS: Final = (
    "smal-waits",
    "smal-unguarded",
)
_BEST: Final = ("smal", "teach-and-repeat", "teach-and-repeat-told")
# Drivers by number of drives.
_USUAL: Final = (*_BEST, "place-filter", f"paper-{DEFAULT_LENGTH}", "nearest-1", "nearest-5")
# Number per drive, for the paper's scheme: 60 for twelve drives, which proved to be enough.
_RECOVERIES: Final = 5
# Light and seasons that differ from the drives.
VARIATIONS: Final = (
    "dark",
    "overcast",
    "evening",
    "other-day",
)
# Changed states of the victim.
ELSEWHERE: Final[tuple[Victim, ...]] = (
    "absent",
    "moved",
    "decoy",
)
# Frame of the kidnapping: well after the start, and far from the goal.
_KIDNAP: Final = 100
#: Cells of a comparison: what differs from teaching, as fields of a `Trial`.
CELLS: Final[dict[str, dict[str, Any]]] = {
    "start": {},
    "anywhere": {"start": "anywhere"},
    "kidnapped": {"kidnap_tick": _KIDNAP},
    "turned": {"start": "turned"},
    "light": {"variation": "evening"},
    "moved-camera": {"moved_camera": True},
    "obstacles": {"obstacles": 3},
    "people": {"people": 3},
    "absent": {"victim": "absent"},
}
#: Searches of a driver in a cell of a comparison.
COMPARED_RUNS: Final = 50


@dataclass(frozen=True)
class Criterion:
    """Largest distance and angle between the true pose and the returned frame of a correct answer."""

    distance_m: float
    angle_deg: float

    @property
    def meaning(self) -> str:
        """Short description."""
        return f"within {self.distance_m:g} m and {self.angle_deg:g}°"


@dataclass(frozen=True)
class RecognizerName:
    """A recognition method: Eq. 9 with a length, or the nearest frames."""

    eq9: bool
    length: int

    @property
    def title(self) -> str:
        """Title on the page."""
        if self.eq9:
            return "single image (l = 1)" if self.length == 1 else f"Eq. 9, l = {self.length}"
        return "nearest frame" if self.length == 1 else f"nearest {self.length} frames"


@dataclass(frozen=True)
class Trial:
    """Searches that differ by seed, divided among sets of drives, each of which teaches alone."""

    driver: str  # Name, as in `driver_entry`.
    drives: int
    runs: int
    degradation: str = "clean"
    variation: str = "day"
    start: Start = "start"
    kidnap_tick: int = 0  # Frame at which the robot is kidnapped; 0 for never.
    sets: int = 1
    victim: Victim = "there"
    obstacles: int = 0
    people: int = 0
    blocked: bool = False
    moved_camera: bool = False  # Whether the camera has moved since teaching.

    @property
    def entry(self) -> DriverEntry:
        """The driver."""
        return driver_entry(self.driver)

    @property
    def length(self) -> int | None:
        """Sequence length of the paper's scheme; None for other drivers."""
        return self.entry.length

    @property
    def cell(self) -> str | None:
        """Name of the cell of a comparison; None for other conditions."""
        cells = (
            name
            for name, changes in CELLS.items()
            if self == Trial(self.driver, 1, self.runs, sets=self.sets, **changes)
        )
        return next(cells, None)

    @property
    def hindered(self) -> bool:
        """Whether there are obstacles that were absent in teaching."""
        return self.obstacles + self.people > 0 or self.blocked

    @property
    def recoveries(self) -> int:
        """Number of recovery drives."""
        return 0 if self.length is None else _RECOVERIES * self.drives

    @property
    def title(self) -> str:
        """Title of the driver on the page."""
        return self.entry.title

    @property
    def condition(self) -> str:
        """Short description of the condition."""
        own = {
            self.variation: self.variation != "day",
            self.degradation: self.degradation != "clean",
            "camera moved": self.moved_camera,
        }
        return condition(vars(self), own)


@dataclass(frozen=True)
class WorldPlan:
    """Experiments in one world."""

    world: str
    criterion: Criterion  # For correct recognition and a correct belief.
    drives: int = 1  # Number of drives to learn recognition from.
    queries: int = 0  # Held-out drives whose frames are recognized, every `JUDGED_TICKS`.
    lengths: tuple[int, ...] = (DEFAULT_LENGTH,)  # Sequence lengths l for precision and recall.
    recognized: tuple[str, ...] = ()  # Degradations of the queries.
    trials: tuple[Trial, ...] = ()
    tasks: bool = False  # Whether to run the tasks, which only the world ``terrace`` has.

    @property
    def title(self) -> str:
        """Name of the world, also if it is a file."""
        return Path(self.world).stem

    @property
    def recognizers(self) -> tuple[RecognizerName, ...]:
        """Recognition methods: Eq. 9 at all lengths, the nearest frame, and the nearest five."""
        return (
            *(RecognizerName(True, length) for length in self.lengths),
            RecognizerName(False, 1),
            RecognizerName(False, 5),
        )

    @property
    def first_judged_tick(self) -> int:
        """First judged frame of a held-out drive, from which every method has a complete window."""
        return max(one.length for one in self.recognizers) - 1


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation, its omissions, and the timeout of a search in longest taught drives (`patience`)."""

    name: str
    worlds: tuple[WorldPlan, ...]
    patience: float = 3.0
    camera: tuple[int, int] = (320, 240)
    base: BaseKind = "physics"  # Motion model of all robots.
    omitted: tuple[str, ...] = ()


def _usual(runs: int) -> tuple[Trial, ...]:
    """Return the searches of the best two methods after one drive: start, anywhere, kidnapped."""
    from_start = [Trial(name, 1, runs, sets=min(runs, TAUGHT)) for name in _BEST]
    others = [replace(one, start="anywhere") for one in from_start[:2]]
    return (*from_start, *others, *(replace(one, kidnap_tick=_KIDNAP) for one in from_start[:2]))


def _conditions(runs: int) -> tuple[Trial, ...]:
    """Return these searches, and from the start: a poor camera, other light, SMAL without the victim."""
    spoilt = [{"degradation": "poor"}, *({"variation": name} for name in VARIATIONS)]
    usual = _usual(runs)
    elsewhere = (replace(usual[0], victim=victim) for victim in ELSEWHERE)
    return (
        *usual,
        *(replace(trial, **one) for trial in usual[: len(_BEST)] for one in spoilt),  # type: ignore[arg-type]
        *elsewhere,
    )


def _trials(
    counts: tuple[int, ...], runs: int, others: int, lengths: tuple[int, ...]
) -> tuple[Trial, ...]:
    """Return the searches of all drivers by number of drives, and of the best two by condition."""
    each = (
        Trial(name, drives, runs if name in _BEST else others)
        for drives in counts
        for name in _USUAL
        if drives > 1 or name not in _BEST
    )
    paper = (
        Trial(f"paper-{length}", max(counts), others, degradation=view)
        for length in lengths
        for view in ("clean", "poor")
    )
    return tuple(dict.fromkeys([*each, *_conditions(runs), *paper]))


_INDOOR: Final = Criterion(0.35, 25.0)
_OUTDOOR: Final = Criterion(3.0, 25.0)
FULL: Final = EvaluationPlan(
    "full",
    (
        *(
            WorldPlan(
                world, criterion, drives=4, queries=3, lengths=(1, 5, 10, 20, 40),
                recognized=("clean", "occluded", "poor"), trials=_trials((1, 2, 4, 12), RUNS, 5, LENGTHS),
            )
            for world, criterion in (("indoor", _INDOOR), ("campus", _OUTDOOR))
        ),
        # A street of similar houses with junctions.
        WorldPlan("terrace", _OUTDOOR, tasks=True, trials=_usual(RUNS)),
    ),
)  # fmt: skip

QUICK: Final = EvaluationPlan(
    "quick",
    (
        WorldPlan(
            "indoor", _INDOOR, drives=2, queries=1, lengths=(1, 5, 20), recognized=("clean", "poor"),
            trials=_trials((1, 2), 3, 3, (1, 5)),
        ),
    ),
    omitted=(
        "the campus, and the terrace with its tasks",
        "4 and 12 drives",
        "lengths of 10 and 40 frames, and searches with 20",
        "most of the runs (3 instead of 5 and 10), so that intervals are wide",
    ),
)  # fmt: skip
PLANS: Final = {plan.name: plan for plan in (QUICK, FULL)}


def with_each(plan: EvaluationPlan, change: Callable[[Trial], Trial]) -> EvaluationPlan:
    """Return a plan with each trial changed, without duplicates.

    If the change hinders SMAL, its variants are compared as well.
    """

    def changed(trial: Trial) -> Iterator[Trial]:
        yield (made := change(trial))
        if made.driver == "smal" and made.hindered and not trial.hindered:
            yield from (replace(made, driver=name) for name in _PARTS)

    worlds = (
        replace(one, trials=tuple(dict.fromkeys(chain(*map(changed, one.trials)))))
        for one in plan.worlds
    )
    return replace(plan, worlds=tuple(worlds))


def comparison(
    plan: EvaluationPlan, drivers: Sequence[str], cells: Sequence[str], runs: int
) -> EvaluationPlan:
    """Return the comparison of drivers in cells, after one drive, in the worlds of a plan.

    Parameters
    ----------
    drivers : sequence of str
        Names, as in `driver_entry`.
    cells : sequence of str
        Names of `CELLS`.
    runs : int
        Number of searches of each driver in each cell.

    Raises
    ------
    UsageError
        A driver or a cell is not found.
    """
    for cell in cells:
        if cell not in CELLS:
            raise UsageError(f"cell {cell!r} not found; choose from {', '.join(CELLS)}")
    for driver in drivers:
        driver_entry(driver)
    trials = tuple(
        Trial(driver, 1, runs, sets=min(runs, TAUGHT), **CELLS[cell])
        for cell in dict.fromkeys(cells)
        for driver in dict.fromkeys(drivers)
    )
    worlds = tuple(WorldPlan(one.world, one.criterion, trials=trials) for one in plan.worlds)
    return replace(plan, name="comparison", worlds=worlds, omitted=())


def in_world(world: str, aside_m: float) -> EvaluationPlan:
    """Return the plan for a custom world: SMAL and teach and repeat after one drive, all conditions."""
    criterion = Criterion(2.0 * aside_m, 25.0)  # Twice the offset of starts beside the route.
    return EvaluationPlan(
        f"in {Path(world).stem}", (WorldPlan(world, criterion, trials=_conditions(RUNS)),)
    )
