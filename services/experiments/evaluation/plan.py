"""What an evaluation runs, as data: `QUICK` and `FULL`."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Final

from schemas.episode import Victim
from schemas.rpc import Start
from services.experiments.words import condition
from services.simulator.opening import BaseKind
from smal.paper.learning import LearningSettings

DEFAULT_LENGTH: Final = LearningSettings().sequence_length  # Of sequences; the filter has none.
#: Seeds of what is learned from begin here, as in the README; those of what is recognized beyond all of them.
TEACHING_SEED = 1
QUERY_SEED = 1000
RUN_SEED = 1
CLOUDS_SEED = 100
JUDGED_TICKS: Final = 4  # From one judged frame to the next: ten a second show nearly the same.
#: How often the searches of SMAL and of its best peer are done, and errands; and after one drive, by how many drives,
#: each of which teaches alone.
RUNS = 10
TAUGHT = 5
#: Who searches: a name for people, and how each decides. All have the same drives.
CONTROLLERS: Final = {
    "smal": ("SMAL", "the filter and the planner, at every frame"),
    "teach-and-repeat": (
        "teach and repeat",
        "wheels, corrected by the shift of the image (Dall'Osto et al. 2021)",
    ),
    "teach-and-repeat-told": (
        "teach and repeat, told",
        "the same, told that it begins where the drive began",
    ),
    "paper": ("the paper's scheme", "a decision every l frames"),
    "nearest-1": ("imitating the nearest frame", "does what was done at the most alike frame"),
    "nearest-5": ("imitating the nearest 5 frames", "the same, of five frames in a row"),
    "smal-waits": (
        "SMAL, stop and wait",
        "it sees no depth: its guard alone stops it before what stands there",
    ),
    "smal-unguarded": ("SMAL, avoidance off", "it has no depth camera, and so no guard"),
}
_PARTS: Final = (
    "smal-waits",
    "smal-unguarded",
)  # What SMAL is compared with where something stands in the way.
_BEST: Final = ("smal", "teach-and-repeat", "teach-and-repeat-told")
_RECOVERIES: Final = (
    5  # For each drive of the paper's scheme: 60 for twelve, which were shown to do.
)
VARIATIONS: Final = (
    "dark",
    "overcast",
    "evening",
    "other-day",
)  # Light and season other than those of the drives.
ELSEWHERE: Final[tuple[Victim, ...]] = (
    "absent",
    "moved",
    "decoy",
)  # How the victim can lie otherwise.
_KIDNAP: Final = (
    100  # Frame at which robots are carried away: a good way from the start, and far from the goal.
)


@dataclass(frozen=True)
class Criterion:
    """When a place is recognized: the demonstrated frame that was taken for it was taken so near to the true pose."""

    distance_m: float
    angle_deg: float

    @property
    def meaning(self) -> str:
        """A few words for people."""
        return f"within {self.distance_m:g} m and {self.angle_deg:g}°"


@dataclass(frozen=True)
class RecognizerName:
    """A way to say which demonstrated frame the robot is at: Eq. 9 of a length, or the nearest frames."""

    eq9: bool
    length: int

    @property
    def title(self) -> str:
        """For people."""
        if self.eq9:
            return "single image (l = 1)" if self.length == 1 else f"Eq. 9, l = {self.length}"
        return "nearest frame" if self.length == 1 else f"nearest {self.length} frames"


@dataclass(frozen=True)
class Trial:
    """Searches that differ in their seed alone, shared out among sets of drives, each of which teaches alone."""

    controller: str
    drives: int
    runs: int
    length: int = DEFAULT_LENGTH  # Of the paper's scheme.
    degradation: str = "clean"
    variation: str = "day"
    start: Start = "start"
    kidnap_tick: int = 0  # At which the robot is carried to another place; 0: never.
    sets: int = 1
    victim: Victim = "there"
    obstacles: int = 0
    people: int = 0
    blocked: bool = False

    @property
    def hindered(self) -> bool:
        """Whether something stands in the way that was not there when it was taught."""
        return self.obstacles + self.people > 0 or self.blocked

    @property
    def recoveries(self) -> int:
        """Drives from beside the way back to it: without them the paper's scheme knows nothing of where it is off."""
        return _RECOVERIES * self.drives if self.controller == "paper" else 0

    @property
    def title(self) -> str:
        """Who drives, for people."""
        name, _ = CONTROLLERS[self.controller]
        return f"{name}, l = {self.length}" if self.controller == "paper" else name

    @property
    def condition(self) -> str:
        """What is special about it, in a few words."""
        own = {
            self.variation: self.variation != "day",
            self.degradation: self.degradation != "clean",
        }
        return condition(vars(self), own)


@dataclass(frozen=True)
class WorldPlan:
    """What is done in one world."""

    world: str
    criterion: Criterion  # Of right recognition, and of a right belief.
    drives: int = 1  # That recognition is learned from.
    queries: int = 0  # Held-out drives whose frames are to be recognized, every `JUDGED_TICKS`.
    lengths: tuple[int, ...] = (DEFAULT_LENGTH,)  # l for precision and recall.
    recognized: tuple[str, ...] = ()  # Degradations of the queries.
    trials: tuple[Trial, ...] = ()
    errands: bool = False  # Whether those are done too, which only the world ``terrace`` has.

    @property
    def title(self) -> str:
        """Its name, also where the world is a file."""
        return Path(self.world).stem

    @property
    def recognizers(self) -> tuple[RecognizerName, ...]:
        """Who recognizes: Eq. 9 at all lengths (l = 1 is the single image), the nearest frame, and the nearest five."""
        return (
            *(RecognizerName(True, length) for length in self.lengths),
            RecognizerName(False, 1),
            RecognizerName(False, 5),
        )

    @property
    def first_judged_tick(self) -> int:
        """Frame of a held-out drive from which on every method has a whole window, and all are judged."""
        return max(one.length for one in self.recognizers) - 1


@dataclass(frozen=True)
class EvaluationPlan:
    """An evaluation; `omitted` is what it leaves out. Searches may take `patience` times the longest taught drive."""

    name: str
    worlds: tuple[WorldPlan, ...]
    patience: float = 3.0
    camera: tuple[int, int] = (320, 240)
    base: BaseKind = "physics"  # Of all robots.
    omitted: tuple[str, ...] = ()


def _usual(runs: int) -> tuple[Trial, ...]:
    """Return the searches of the best two after one drive: from the start, anywhere beside the way, and kidnapped."""
    from_start = [Trial(name, 1, runs, sets=min(runs, TAUGHT)) for name in _BEST]
    others = [replace(one, start="anywhere") for one in from_start[:2]]
    return (*from_start, *others, *(replace(one, kidnap_tick=_KIDNAP) for one in from_start[:2]))


def _conditions(runs: int) -> tuple[Trial, ...]:
    """Return those, the same from the start with a poor camera and in other light, and SMAL's without the victim."""
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
    """Return searches of all controllers after each number of drives, of the best two under every condition too."""
    each = (
        Trial(name, drives, runs if name in _BEST else others)
        for drives in counts
        for name in CONTROLLERS
        if name not in _PARTS and (drives > 1 or name not in _BEST)
    )
    paper = (
        Trial("paper", max(counts), others, length, view)
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
                recognized=("clean", "occluded", "poor"), trials=_trials((1, 2, 4, 12), RUNS, 5, (1, 2, 5, 10, 20, 40)),
            )
            for world, criterion in (("indoor", _INDOOR), ("campus", _OUTDOOR))
        ),
        # A street of houses that look the same, and streets to choose from.
        WorldPlan("terrace", _OUTDOOR, errands=True, trials=_usual(RUNS)),
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
        "the campus, and the terrace with its errands",
        "4 and 12 drives",
        "lengths of 10 and 40 frames, and searches with 20",
        "most of the runs (3 instead of 5 and 10), so that intervals are wide",
    ),
)  # fmt: skip
PLANS: Final = {plan.name: plan for plan in (QUICK, FULL)}


def with_each(plan: EvaluationPlan, change: Callable[[Trial], Trial]) -> EvaluationPlan:
    """Return a plan in which each trial is changed; of those that are the same then, one is left."""

    def changed(trial: Trial) -> Iterator[Trial]:
        yield (made := change(trial))
        if made.controller == "smal" and made.hindered:
            yield from (replace(made, controller=name) for name in _PARTS)

    worlds = (
        replace(one, trials=tuple(dict.fromkeys(chain(*map(changed, one.trials)))))
        for one in plan.worlds
    )
    return replace(plan, worlds=tuple(worlds))


def in_world(world: str, aside_m: float) -> EvaluationPlan:
    """Return the plan for a world of one's own: SMAL and teach and repeat after one drive, under every condition."""
    criterion = Criterion(2.0 * aside_m, 25.0)  # Twice as far as searches begin beside the way.
    return EvaluationPlan(
        f"in {Path(world).stem}", (WorldPlan(world, criterion, trials=_conditions(RUNS)),)
    )
