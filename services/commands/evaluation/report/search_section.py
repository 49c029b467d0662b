"""The part of the report about searches: how often each way to drive finds the victim in a world, and an example."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from services.commands import html
from services.commands.evaluation.plan import DEFAULT_LENGTH, SCHEMES
from services.commands.evaluation.report import search_figures as figures
from services.commands.evaluation.report.embedding import EmbeddedFigures
from services.commands.evaluation.report.summary import Results, Success, controller_name
from services.commands.evaluation.results import ResultStore
from services.commands.evaluation.search_experiment import read_route, route_file

_WITHOUT_CLONING: Final = " <b>Behaviour cloning was not run</b>: torch is not installed (pip install -e '.[cloning]')."


def search_section(
    found: Results, max_ticks: int, store: ResultStore, put: EmbeddedFigures, *, cloning: bool
) -> Iterator[str]:
    """Write it as HTML, piece by piece; `cloning` says whether behaviour cloning is a part of it."""
    name = found.world.world
    ways = {(one.controller, one.length) for one in found.successes}
    yield "<h3>Finding the victim</h3>"
    if any(controller == "paper" for controller, _ in ways):
        yield put(
            f"success-{name}",
            figures.success_by_length(found.successes, f"Success over sequence length, {name}"),
            f"Share of {found.world.runs} searches that find the victim without a collision, over l, by the paper's "
            "scheme (its figure of success rates in its parameter analysis). Bars are Wilson's 95 % intervals. Starts "
            "were not used in teaching, and are the same for all.",
        )
    if ("smal", DEFAULT_LENGTH) in ways:
        yield put(
            f"peers-{name}",
            figures.peers(found.successes, f"SMAL and its peers, {name}"),
            "The same demonstrations, starts and damage for all. With l = 1 the paper's scheme is the single image. "
            f"The others imitate the expert without states.{'' if cloning else _WITHOUT_CLONING}",
        )
    yield put(
        f"time-{name}",
        figures.found_over_time(found.successes, max_ticks, f"Until the victim is found, {name}"),
        f"The same searches over time. What has not found the victim after {max_ticks} frames, or has collided, never "
        "rises; the table below says which.",
    )
    yield _table(found.successes)
    yield from _example(found, store, put)


def _table(found: Sequence[Success]) -> str:
    rows = []
    for one in found:
        outcomes = list(one.outcomes.values())
        scheme = SCHEMES.get(one.controller, "-")
        ticks = one.median_ticks
        rows.append([
            controller_name(one.controller, one.length), scheme, one.degradation, f"{one.found} of {one.runs}",
            f"{one.rate:.0%}", "{:.0%} to {:.0%}".format(*one.wilson_95), str(outcomes.count("collision")),
            str(outcomes.count("timeout")), "-" if ticks is None else f"{ticks:.0f}",
        ])  # fmt: skip
    head = ["driver", "decides", "view", "found", "rate", "95 %", "collisions", "out of time", "frames until found"]
    return html.table(head, rows, left=3)


def _example(found: Results, store: ResultStore, put: EmbeddedFigures) -> Iterator[str]:
    """Show the first search of SMAL, with a clear view, that found the victim."""
    name = found.world.world
    mine = next(
        (one for one in found.successes
         if (one.controller, one.degradation) == ("smal", "clean")), None
    )  # fmt: skip
    seed = None if mine is None else next((s for s, how in mine.outcomes.items() if how == "found"), None)
    yield "<h3>An example</h3>"
    if seed is None or not (store.work / route_file(name, seed)).exists():
        yield "<p>No search of SMAL found the victim, or its pictures were deleted: no example.</p>"
        return
    degraded = next((view for view in found.world.peers if view != "clean"), None)
    yield put(
        f"route-{name}",
        figures.example_route(name, read_route(store.work / route_file(name, seed)), seed, degraded,
                              f"A search in the world {name}, seed {seed}"),
        "The way of a successful search from a start that was not taught (arrow) to the victim (star), and what the "
        "camera saw at the numbered places (the paper's figures of route and observations). The lower row shows the "
        "same views under the declared degradation.",
    )  # fmt: skip
