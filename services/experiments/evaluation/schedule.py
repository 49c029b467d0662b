"""The units of work that a plan comes to."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from services.experiments.evaluation.plan import (
    DEFAULT_LENGTH,
    QUERY_SEED,
    RUN_SEED,
    RUNS,
    TEACHING_SEED,
    Plan,
    Trial,
    WorldPlan,
)

Settings = tuple[tuple[str, str | int], ...]
Kind = Literal["teach", "learn", "queries", "recognize", "objective", "search", "errand"]


@dataclass(frozen=True)
class Unit:
    """A piece of work that is done once.

    Attributes
    ----------
    kind, world
        What, and where.
    settings
        All else that determines it; numbers and texts.
    needs
        Keys of the units that must be done before.
    """

    kind: Kind
    world: str
    settings: Settings
    needs: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> str | int:
        """Return one of the settings."""
        return dict(self.settings)[name]

    def number(self, name: str) -> int:
        """Return a setting that is a number."""
        return int(self[name])

    def text(self, name: str) -> str:
        """Return a setting that is a text."""
        return str(self[name])

    @property
    def key(self) -> str:
        """What determines it, in one line."""
        return "/".join([self.kind, self.world, *(f"{name}={value}" for name, value in self.settings)])


def units(plan: Plan) -> list[Unit]:
    """Return all units of a plan, each after those that it needs."""
    return [unit for world in plan.worlds for unit in (*_of_world(plan, world), *_errands(plan, world))]


def whole_series(units: Sequence[Unit], done: Container[str]) -> list[Unit]:
    """Return those units that can be reported: all that differ in their seed alone are done."""

    def series(unit: Unit) -> tuple[object, ...]:
        return unit.kind, unit.world, *(one for one in unit.settings if one[0] != "seed")

    torn = {series(unit) for unit in units if unit.key not in done}
    return [unit for unit in units if series(unit) not in torn]


def _of_world(plan: Plan, world: WorldPlan) -> Iterator[Unit]:
    camera = ("camera", "x".join(map(str, plan.camera)))
    taught = [Unit("teach", world.world, (camera, ("seed", TEACHING_SEED + k))) for k in range(world.all_drives)]
    yield from taught
    learned = {}
    for drives, length in world.models:
        settings = (camera, ("drives", drives), ("length", length))
        needs = tuple(unit.key for unit in taught[:drives])
        learned[drives, length] = Unit("learn", world.world, settings, needs)
        yield learned[drives, length]
    queries = [Unit("queries", world.world, (camera, ("seed", QUERY_SEED + k))) for k in range(world.queries)]
    yield from queries

    # Who recognizes or searches needs the drives beside the model: their poses, or to imitate them.
    def needed(drives: int, length: int | None) -> tuple[str, ...]:
        models = () if length is None else (learned[drives, length].key,)
        return (*models, *(unit.key for unit in taught[:drives]))

    for recognizer in world.recognizers:
        model = recognizer.length if recognizer.name == "smal" else None
        for degradation in world.recognized:
            for k, query in enumerate(queries):
                asked: Settings = (camera, ("drives", world.drives), ("method", recognizer.name),
                            ("length", recognizer.length), ("degradation", degradation),
                            ("seed", QUERY_SEED + k))  # fmt: skip
                yield Unit("recognize", world.world, asked, (*needed(world.drives, model), query.key))
    if queries:
        at = (camera, ("drives", world.drives), ("length", DEFAULT_LENGTH), ("seed", QUERY_SEED),
              ("templates", world.template_frames))  # fmt: skip
        yield Unit("objective", world.world, at, (*needed(world.drives, DEFAULT_LENGTH), queries[0].key))
    # What tells most first: whoever looks at the page before all is done sees the method and its peers.
    for trial in world.trials:
        model = trial.length if trial.controller in {"smal", "paper"} else None
        for k in range(trial.runs):
            tried: Settings = (camera, *settings_of(trial), ("patience", str(plan.patience)), ("seed", RUN_SEED + k))
            yield Unit("search", world.world, tried, needed(trial.drives, model))


def _errands(plan: Plan, world: WorldPlan) -> Iterator[Unit]:
    camera = ("camera", "x".join(map(str, plan.camera)))
    for errand in world.errands:
        yield Unit("errand", world.world, (camera, ("errand", errand), ("runs", RUNS)))


def settings_of(trial: Trial) -> Settings:
    """Return what determines a trial, but for its runs."""
    return tuple((name, value) for name, value in asdict(trial).items() if name != "runs")
