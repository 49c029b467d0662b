"""The units of work that a plan comes to: each is a pure function of its settings and of the units that it needs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from services.experiments.evaluation.plan import (
    DEFAULT_LENGTH,
    QUERY_SEED,
    RUN_SEED,
    RUNS,
    TEACHING_SEED,
    Plan,
    Recognizer,
    Trial,
    WorldPlan,
)

Kind = Literal["teach", "learn", "queries", "recognize", "objective", "search", "errand"]
#: What holds our packages: a checkout, or where they are installed.
_PACKAGES: Final = Path(__file__).parents[3]
# Whatever a result depends on; that the report is written differently invalidates nothing.
_SOURCES: Final = (
    "smal/**/*.py", "services/simulator/**/*", "services/robot/*.py", "services/expert/*.py",
    "services/experiments/evaluation/*.py",
)  # fmt: skip
_OF_NO_RESULT: Final = ("plan.py", "units.py", "results.py", "pool.py")


@dataclass(frozen=True)
class Unit:
    """A piece of work that is done once.

    Attributes
    ----------
    kind
        What to do, a row of `work.KINDS`.
    settings
        All that determines it: names, with numbers and texts.
    needs
        Units whose files it reads, which must be done before.
    """

    kind: Kind
    settings: tuple[tuple[str, Any], ...]
    needs: tuple[Unit, ...] = field(default=(), repr=False)

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - as JSON has it
        """Return one of the settings."""
        return dict(self.settings)[name]

    @property
    def key(self) -> str:
        """What determines it, in one line for people."""
        return "/".join([self.kind, *(f"{name}={value}" for name, value in self.settings)])

    @property
    def digest(self) -> str:
        """Name of its result's files: another setting, or another version of the code, is another result."""
        text = json.dumps([code_fingerprint(), self.kind, self.settings])
        return hashlib.sha256(text.encode()).hexdigest()[:24]

    @property
    def series(self) -> tuple[Any, ...]:
        """What it has in common with those that differ in their seed alone."""
        return self.kind, *(one for one in self.settings if one[0] != "seed")


def sources() -> list[Path]:
    """Return the code, the shaders and the worlds that results depend on."""
    found = {path for pattern in _SOURCES for path in _PACKAGES.glob(pattern)}
    found -= {Path(__file__).with_name(name) for name in _OF_NO_RESULT}
    return sorted(path for path in found if path.is_file() and path.suffix != ".pyc")


@cache
def code_fingerprint() -> str:
    """Return the digest of the code that results depend on."""
    digest = hashlib.sha256()
    for path in sources():
        digest.update(str(path.relative_to(_PACKAGES)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def whole_series(units: Sequence[Unit], done: Collection[Unit]) -> list[Unit]:
    """Return those units that can be reported: all that differ in their seed alone are done."""
    torn = {unit.series for unit in units if unit not in done}
    return [unit for unit in units if unit.series not in torn]


def units(plan: Plan) -> list[Unit]:
    """Return all units of a plan, each once and after those that it needs; what tells most comes first."""
    found: dict[Unit, None] = {}

    def add(unit: Unit) -> None:
        for needed in unit.needs:
            add(needed)
        found[unit] = None

    for world in plan.worlds:
        for unit in _of_world(world, plan):
            add(unit)
    return list(found)


def _of_world(world: WorldPlan, plan: Plan) -> Iterator[Unit]:
    at = _at(world, plan)
    yield from (search_unit(world, plan, trial, RUN_SEED + k) for trial in world.trials for k in range(trial.runs))
    queries = [query_unit(world, plan, QUERY_SEED + k) for k in range(world.queries)]
    for recognizer in world.recognizers if queries else ():
        for degradation in world.recognized:
            yield from (recognize_unit(world, plan, recognizer, degradation, query) for query in queries)
    if queries:
        settings = (*at, ("drives", world.drives), ("templates", world.template_frames))
        yield Unit("objective", settings, (_learned(world, plan, world.drives, DEFAULT_LENGTH), queries[0]))
    for errand in world.errands:
        yield Unit("errand", (*at, ("errand", errand), ("runs", RUNS)))


def _at(world: WorldPlan, plan: Plan) -> tuple[tuple[str, Any], ...]:
    """Return where: another map in a file of the same name is another world."""
    path = Path(world.world)
    content = (("content", hashlib.sha256(path.read_bytes()).hexdigest()[:12]),) if path.is_file() else ()
    return (("world", world.world), *content, ("camera", plan.camera))


def _taught(world: WorldPlan, plan: Plan, drives: int) -> tuple[Unit, ...]:
    return tuple(Unit("teach", (*_at(world, plan), ("seed", TEACHING_SEED + k))) for k in range(drives))


def _learned(world: WorldPlan, plan: Plan, drives: int, length: int) -> Unit:
    """Learn a map (length 0), or a model of the paper."""
    settings = (*_at(world, plan), ("drives", drives), ("length", length))
    return Unit("learn", settings, _taught(world, plan, drives))


def query_unit(world: WorldPlan, plan: Plan, seed: int) -> Unit:
    """Drive a way that is not taught, and keep what is seen under every degradation; the objective's is clear."""
    degradations = tuple(dict.fromkeys(("clean", *world.recognized)))
    return Unit("queries", (*_at(world, plan), ("degradations", degradations), ("seed", seed)))


def recognize_unit(world: WorldPlan, plan: Plan, recognizer: Recognizer, degradation: str, query: Unit) -> Unit:
    """Have a method recognize the frames of a held-out drive."""
    criteria = tuple((one.distance_m, one.angle_deg) for one in world.criteria)
    settings = (
        *_at(world, plan), ("drives", world.drives), ("method", recognizer.name),
        ("length", recognizer.length), ("degradation", degradation), ("criteria", criteria), ("seed", query["seed"]),
    )  # fmt: skip
    smal = recognizer.name == "smal"
    model = (_learned(world, plan, world.drives, recognizer.length),) if smal else ()
    return Unit("recognize", settings, (*_taught(world, plan, world.drives), *model, query))


def search_unit(world: WorldPlan, plan: Plan, trial: Trial, seed: int) -> Unit:
    """Search once."""
    criterion = (world.criteria[0].distance_m, world.criteria[0].angle_deg)
    settings = (
        *_at(world, plan), *settings_of(trial), ("patience", plan.patience),
        ("criterion", criterion), ("seed", seed),
    )  # fmt: skip
    length = {"smal": 0, "paper": trial.length}.get(trial.controller)
    model = () if length is None else (_learned(world, plan, trial.drives, length),)
    return Unit("search", settings, (*_taught(world, plan, trial.drives), *model))


def settings_of(trial: Trial) -> tuple[tuple[str, Any], ...]:
    """Return what determines a trial, but for its runs."""
    return tuple((name, value) for name, value in asdict(trial).items() if name != "runs")
