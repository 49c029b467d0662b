"""The units of work that a plan comes to, and about how long each takes."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from services.commands.evaluation.plan import (
    DEFAULT_LENGTH,
    JUDGED_TICKS,
    PEERS,
    QUERY_SEED,
    RUN_SEED,
    TEACHING_SEED,
    Plan,
    Recogniser,
    WorldPlan,
)

Kind = Literal["teach", "learn", "queries", "recognise", "objective", "search"]
#: Whole drives, and recoveries, that are made as one unit of work.
_DRIVES_AT_A_TIME, _RECOVERIES_AT_A_TIME = 3, 15


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
    seconds
        About how long it takes, for the progress bar.
    """

    kind: Kind
    world: str
    settings: tuple[tuple[str, str | int], ...]
    needs: tuple[str, ...] = ()
    seconds: float = 1.0

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


class _Costs:
    """About how many seconds things take on one core, as measured on one machine; only for the progress bar."""

    def __init__(self, world: WorldPlan, max_ticks: int) -> None:
        self.max_ticks, self.drives = max_ticks, world.drives
        outdoors = world.world == "campus"
        self.frame_s = 0.015 if outdoors else 0.008
        self.drive_frames = 560 if outdoors else 330
        #: Frames that are learned from, in thousands.
        self.learned = (world.drives * self.drive_frames + world.recoveries * 72) / 1e3

    @property
    def drive_s(self) -> float:
        return self.drive_frames * self.frame_s

    def match_s(self, length: int) -> float:
        """Return what matching a window costs in a stream of frames."""
        return 1e-3 + (1e-4 * length + 1.1e-5 * length**2) * self.learned

    def learn_s(self, length: int) -> float:
        """Return what learning costs; one model has the map of views."""
        return 1.0 + 1.5 * self.learned + (0.1 * self.drives * self.drive_frames if length == DEFAULT_LENGTH else 0.0)

    def recognise_s(self, recogniser: Recogniser) -> float:
        """Return what recognising a drive costs; its frames are far apart, and the first match prepares templates."""
        if recogniser.name != "smal":
            return 1.0
        return 2.5 + self.drive_frames / JUDGED_TICKS * (0.02 + self.match_s(recogniser.length))

    def search_s(self, controller: str, length: int, degradation: str) -> float:
        """Return what a search costs; where frames are occluded it lasts longer, and matching takes longer."""
        longer = 1.0 if degradation == "clean" else 1.5
        frames = self.drive_frames * longer
        if controller != "paper":
            return frames * (self.frame_s + 5e-3)
        if longer > 1.0 or length > 1:
            # It gets lost, and stands until the time is out.
            return self.max_ticks * (self.frame_s + 3e-3)
        return frames * (self.frame_s + self.match_s(length))


def units(plan: Plan, *, cloning: bool) -> list[Unit]:
    """Return all units of a plan, each after those that it needs.

    Parameters
    ----------
    plan
        What is to be done.
    cloning
        Whether behaviour cloning can run on this machine.
    """
    return [unit for world in plan.worlds for unit in _of_world(plan, world, cloning)]


def whole_series(units: Sequence[Unit], done: Container[str]) -> list[Unit]:
    """Return those units that can be reported: all that differ in their seed alone are done."""

    def series(unit: Unit) -> tuple[object, ...]:
        return unit.kind, unit.world, *(one for one in unit.settings if one[0] != "seed")

    torn = {series(unit) for unit in units if unit.key not in done}
    return [unit for unit in units if series(unit) not in torn]


def _of_world(plan: Plan, world: WorldPlan, cloning: bool) -> Iterator[Unit]:
    costs = _Costs(world, plan.max_ticks)
    taught = ("teaching", plan.teaching(world))
    teaching = list(_teaching(world, taught, costs))
    yield from teaching
    learned = {}
    for length in world.all_lengths:
        settings = (taught, ("length", length))
        needs = tuple(unit.key for unit in teaching)
        learned[length] = Unit("learn", world.world, settings, needs, costs.learn_s(length))
        yield learned[length]
    queries = [
        Unit("queries", world.world, (taught, ("seed", QUERY_SEED + k)), (), 1.1 * costs.drive_s)
        for k in range(world.queries)
    ]
    yield from queries
    # Who recognises or searches needs the drives beside the model: their poses, or to imitate them.
    drives = tuple(unit.key for unit in teaching)
    model = {length: (unit.key, *drives) for length, unit in learned.items()}
    yield from _recognition(world, taught, model, [unit.key for unit in queries], costs)
    if queries:
        at = (taught, ("length", DEFAULT_LENGTH), ("seed", QUERY_SEED), ("templates", world.template_frames))
        cost_s = 5.0 * (world.template_frames / 1000) ** 3
        yield Unit("objective", world.world, at, (*model[DEFAULT_LENGTH], queries[0].key), cost_s)
    yield from _searches(plan, world, taught, model, costs, cloning)


def _teaching(world: WorldPlan, taught: tuple[str, str], costs: _Costs) -> Iterator[Unit]:
    kinds = (("drive", world.drives, _DRIVES_AT_A_TIME, costs.drive_s),
             ("recovery", world.recoveries, _RECOVERIES_AT_A_TIME, 0.2 * costs.drive_s))  # fmt: skip
    for purpose, count, together, each_s in kinds:
        for first in range(0, count, together):
            number = min(together, count - first)
            settings = (taught, ("purpose", purpose), ("seed", TEACHING_SEED + first), ("count", number))
            yield Unit("teach", world.world, settings, (), number * each_s)


def _recognition(
    world: WorldPlan, taught: tuple[str, str], model: dict[int, tuple[str, ...]], queries: list[str], costs: _Costs
) -> Iterator[Unit]:
    for recogniser in world.recognisers:
        # A peer needs no model, but the drives.
        needed = model[recogniser.length if recogniser.name == "smal" else DEFAULT_LENGTH]
        for degradation in world.recognised:
            for k, query in enumerate(queries):
                settings = (taught, ("method", recogniser.name), ("length", recogniser.length),
                            ("degradation", degradation), ("seed", QUERY_SEED + k))  # fmt: skip
                yield Unit("recognise", world.world, settings, (*needed, query), costs.recognise_s(recogniser))


def _searches(
    plan: Plan,
    world: WorldPlan,
    taught: tuple[str, str],
    model: dict[int, tuple[str, ...]],
    costs: _Costs,
    cloning: bool,
) -> Iterator[Unit]:
    limit = ("max_ticks", plan.max_ticks)
    # What tells most first: whoever looks at the page before all is done sees the method and its peers.
    asked = [("smal", DEFAULT_LENGTH, degradation) for degradation in world.peers]
    asked += [("paper", 1, degradation) for degradation in world.peers]
    asked += [
        (peer, DEFAULT_LENGTH, degradation)
        for peer in PEERS
        if cloning or peer != "cloning"
        for degradation in world.peers
    ]
    asked += [
        (scheme, length, degradation)
        for scheme, degradations in world.searched.items()
        for length in (world.search_lengths if scheme == "paper" else (DEFAULT_LENGTH,))
        for degradation in degradations
    ]
    for controller, length, degradation in dict.fromkeys(asked):
        for k in range(world.runs):
            settings = (taught, ("controller", controller), ("length", length), ("degradation", degradation),
                        ("seed", RUN_SEED + k), limit)  # fmt: skip
            yield Unit("search", world.world, settings, model[length], costs.search_s(controller, length, degradation))
