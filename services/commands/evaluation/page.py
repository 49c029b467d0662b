"""The page of an evaluation: one HTML file that needs nothing beside it, and beside it every figure and number."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.commands import html
from services.commands.evaluation import figures
from services.commands.evaluation.degradation import degradation_named
from services.commands.evaluation.plan import (
    DEFAULT_LENGTH,
    JUDGED_TICKS,
    QUERY_SEED,
    RUN_SEED,
    SCHEMES,
    TEACHING_SEED,
    Plan,
    WorldPlan,
)
from services.commands.evaluation.results import Finding, ResultStore, program_version
from services.commands.evaluation.search_experiment import route_file
from services.commands.evaluation.summary import (
    Comparison,
    Recognised,
    Results,
    Success,
    as_json,
    compare_recognition,
    compare_searches,
    controller_name,
    long_sequences,
    results_of,
)
from services.commands.evaluation.units import Unit

_DPI: Final = 130
_VERDICT: Final = {"ahead": "yes", "behind": "no", "open": "not shown", "counts": "-"}


class _Figures:
    """Writes each figure as a file, and embeds it with its caption."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(exist_ok=True)

    def __call__(self, name: str, figure: Figure, caption: str) -> str:
        data = html.png(figure, _DPI)
        (self._folder / f"{name}.png").write_bytes(data)
        return f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'


def write_page(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Path:
    """Write ``index.html``, ``results.json`` and the figures into the folder of the results.

    Parameters
    ----------
    plan, units
        What was run, all of it.
    store
        What was found out.

    Returns
    -------
    Path
        Of the page.
    """
    found = [results_of(world, units, store.findings) for world in plan.worlds]
    compared = [one for each in found for one in comparisons(each)]
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "machine_seconds": _seconds(units, store.findings),
        "comparisons": [{"world": c.world, "verdict": c.verdict, "text": c.text} for c in compared],
        "worlds": as_json(found),
    }
    (store.folder / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    put = _Figures(store.folder / "figures")
    body = [*_introduction(plan, units, store), *_summary(compared)]
    for each in found:
        body += _world(each, store, put)
    body += [*_objective(found, put), *_method(plan, units, store)]
    path = store.folder / "index.html"
    path.write_text(html.page(f"SMAL: evaluation in simulation ({plan.name})", "\n".join(body), 72), encoding="utf-8")
    return path


def comparisons(found: Results) -> list[Comparison]:
    """Return what the page says in words about a world."""
    name = found.world.world
    return [
        *compare_recognition(name, found.recognised[0]),
        *compare_searches(name, found.successes),
        *long_sequences(name, found.successes),
    ]


def _seconds(units: Sequence[Unit], findings: Mapping[str, Finding]) -> float:
    return round(sum(float(findings[unit.key]["cpu_s"]) for unit in units), 1)


def _introduction(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Iterator[str]:
    seconds = _seconds(units, store.findings)
    time = f"{seconds / 3600:.1f} h" if seconds > 7200 else f"{seconds / 60:.0f} min"
    yield (
        "<p>The experiments of Han, Yang, Zhang and Zhang, <em>Sequence-based Multimodal Apprenticeship Learning for "
        "Robot Perception and Decision Making</em> (ICRA 2017), repeated in simulation, and taken further. A scripted "
        "expert drives the robot to a victim; from camera images and keys alone SMAL learns states, actions, "
        "transitions and a reward; then the robot searches by itself from other starts.</p>"
    )
    if plan.omitted:
        yield f"<p><b>This is the quick evaluation.</b> It leaves out: {'; '.join(map(escape, plan.omitted))}.</p>"
    searches = sum(unit.kind == "search" for unit in units)
    queries = sum(int(store.findings[unit.key]["frames"]) for unit in units if unit.kind == "queries")
    yield html.tiles(
        {
            "worlds": ", ".join(world.world for world in plan.worlds),
            "searches": str(searches),
            "held-out frames": f"{queries:,}",
            "processor time": time,
            "version": program_version(),
        }
    )


def _summary(compared: Iterable[Comparison]) -> Iterator[str]:
    yield "<h2>In words</h2>"
    yield (
        f"<p>SMAL at its defaults (l = {DEFAULT_LENGTH}) against each other method; “ahead” and “behind” only where "
        "the 95 % interval of the difference of areas leaves out zero, or the exact sign test on the same seeds has p "
        "below 0.05. All of it is computed from the results below.</p>"
    )
    rows = [
        f'<tr><td class="text">{escape(one.world)}</td><td class="text">{escape(one.text)}</td>'
        f'<td class="text {one.verdict}">{_VERDICT[one.verdict]}</td></tr>'
        for one in compared
    ]
    head = '<tr><th class="text">world</th><th class="text">result</th><th class="text">SMAL ahead?</th></tr>'
    yield f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _world(found: Results, store: ResultStore, put: _Figures) -> Iterator[str]:
    world = found.world
    name = world.world
    yield f"<h2>{escape(name.capitalize())}</h2>"
    yield f"<h3>Recognising where the robot is</h3>{_recognition_text(world)}"
    yield put(
        f"precision-recall-{name}",
        figures.precision_recall(found.recognised[0], f"State recognition, {name}"),
        f"Precision over recall as the score's threshold falls, {_paper_part(name, 'pr')}. A cross is where SMAL's own "
        "novelty test works. Closer to the top right is better.",
    )
    yield put(
        f"precision-recall-lengths-{name}",
        figures.precision_recall_by_length(found.recognised[0], f"Sequence lengths, {name}"),
        "The same for SMAL with sequences of l frames (the paper's figure of precision-recall curves in its parameter "
        "analysis). Frames before the first whole window have no answer, so that long sequences cannot reach full "
        "recall.",
    )
    yield put(
        f"area-lengths-{name}",
        figures.area_by_length(found.recognised[0], f"Area under the curve over l, {name}"),
        "Areas of the curves above; bars are 95 % intervals of a block bootstrap over the held-out frames.",
    )
    for criterion, judged in zip(world.criteria, found.recognised, strict=True):
        yield f"<p>By the criterion <b>{escape(criterion.meaning)}</b>:</p>{_recognition_table(judged)}"
    if found.successes:
        yield from _searches(found, store, put)


def _recognition_text(world: WorldPlan) -> str:
    first = world.criteria[0]
    others = " and ".join(escape(one.meaning) for one in world.criteria[1:])
    views = "; ".join(f"<b>{name}</b>: {escape(degradation_named(name).meaning)}" for name in world.recognised)
    return (
        "<p><b>One criterion for all methods:</b> an answer is right if the demonstrated frame that the method takes "
        f"the robot to be at was taken {escape(first.meaning)} of the robot's true pose"
        f"{f' (beside it, stricter: {others})' if others else ''}. For SMAL that is the nearest demonstrated "
        "occurrence of the state and phase that it recognises. The score is the weight of the best sequence (Eq. 8), "
        "for each frame, whether or not the novelty test lets it pass; for the nearest frames the negative distance, "
        "for SeqSLAM the negative mean difference along its best trajectory. Recall counts all frames that have a "
        f"right answer among the demonstrations. Queries are one in {JUDGED_TICKS} frames of "
        f"{world.queries} held-out drive{'' if world.queries == 1 else 's'}. Views: {views}.</p>"
    )


def _paper_part(world: str, figure: str) -> str:
    scene = "the indoor search" if world == "indoor" else "the urban search"
    kind = "precision-recall curves" if figure == "pr" else "objective value"
    return f"as in the paper's figure of {kind} of {scene}"


def _recognition_table(found: Sequence[Recognised]) -> str:
    rows = [
        [
            one.name,
            one.degradation,
            f"{one.curve.auc:.3f}",
            _interval(one.auc_95),
            f"{one.curve.recall_at_100_precision:.3f}",
            _interval(one.recall_95),
            "-" if one.operating is None else f"{one.operating[1]:.3f} at {one.operating[0]:.3f}",
            f"{int(one.judgement.findable.sum())} of {one.judgement.score.size}",
        ]
        for one in found
    ]
    head = ["method", "view", "area", "95 %", "recall at 100 % precision", "95 %", "novelty test: precision at recall",
            "frames with a right answer"]  # fmt: skip
    return html.table(head, rows, left=2)


def _interval(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3f} to {ends[1]:.3f}"


def _searches(found: Results, store: ResultStore, put: _Figures) -> Iterator[str]:
    name = found.world.world
    yield "<h3>Finding the victim</h3>"
    yield put(
        f"success-{name}",
        figures.success_by_length(found.successes, f"Success over sequence length, {name}"),
        f"Share of {found.world.runs} searches that find the victim without a collision, over l, for each way to "
        "decide (the paper's figure of success rates in its parameter analysis). Bars are Wilson's 95 % intervals. "
        "Starts were not used in teaching, and are the same for all. With l = 1 every decision is of one frame, so "
        "that the paper's scheme and overlapping windows are the same.",
    )
    yield put(
        f"peers-{name}",
        figures.peers(found.successes, f"SMAL and its peers, {name}"),
        "The same demonstrations, starts and damage for all. The single image has SMAL's features and decision making; "
        "SeqSLAM has SMAL's policy and another way to say where the robot is; the others imitate the expert without "
        f"states.{_about_cloning(found.successes)}",
    )
    yield _success_table(found.successes)
    yield from _example(found, store, put)


def _about_cloning(found: Sequence[Success]) -> str:
    if any(one.controller == "cloning" for one in found):
        return ""
    return (
        " <b>Behaviour cloning was not run</b>: torch was not installed when this evaluation began "
        "(pip install 'smal[cloning]')."
    )


def _success_table(found: Sequence[Success]) -> str:
    rows = []
    for one in found:
        outcomes = list(one.outcomes.values())
        scheme = SCHEMES[one.controller].meaning if one.controller in SCHEMES else "-"
        ticks = one.median_ticks
        rows.append([
            controller_name(one.controller, one.length), scheme, one.degradation, f"{one.found} of {one.runs}",
            f"{one.rate:.0%}", "{:.0%} to {:.0%}".format(*one.wilson_95), str(outcomes.count("collision")),
            str(outcomes.count("timeout")), "-" if ticks is None else f"{ticks:.0f}",
        ])  # fmt: skip
    head = ["driver", "decides", "view", "found", "rate", "95 %", "collisions", "out of time", "frames until found"]
    return html.table(head, rows, left=3)


def _example(found: Results, store: ResultStore, put: _Figures) -> Iterator[str]:
    """Show the first search of SMAL at its defaults, with a clear view, that found the victim."""
    name = found.world.world
    mine = next(
        (one for one in found.successes
         if (one.controller, one.length, one.degradation) == ("smal", DEFAULT_LENGTH, "clean")), None
    )  # fmt: skip
    seed = None if mine is None else next((s for s, how in mine.outcomes.items() if how == "found"), None)
    yield "<h3>An example</h3>"
    if seed is None or not (store.work / route_file(name, seed)).exists():
        yield "<p>No search of SMAL at its defaults found the victim, or its pictures were deleted: no example.</p>"
        return
    degraded = next((view for view in found.world.peers if view != "clean"), None)
    yield put(
        f"route-{name}",
        figures.example_route(name, _arrays(store.work / route_file(name, seed)), seed, degraded,
                              f"A search in the world {name}, seed {seed}"),
        "The way of a successful search from a start that was not taught (arrow) to the victim (star), and what the "
        "camera saw at the numbered places (the paper's figures of route and observations). The lower row shows the "
        "same views under the declared degradation.",
    )  # fmt: skip


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as held:
        return {name: held[name] for name in held.files}


def _objective(found: Sequence[Results], put: _Figures) -> Iterator[str]:
    each = {one.world.world: one.objective for one in found if one.objective is not None}
    if not each:
        return
    yield "<h2>Objective value over iterations</h2>"
    yield put(
        "objective",
        figures.objective(each),
        "Eq. 7 on one held-out query, after every iteration of Algorithm 2 as published and of this project's solver "
        "(one point for each tolerance, with its own certificate), as in the paper's figures of the objective value. "
        "Below: how far above the optimum, at most. The paper reports 9 and 12 iterations. An iteration of Algorithm 2 "
        "solves dense systems of all template frames, one of ours a small one of those that have a weight.",
    )
    rows = []
    for world, one in each.items():
        within = next((k for k, value in enumerate(one["algorithm2"], 1)
                       if (value - one["lower_bound"]) / value <= 1e-3), None)  # fmt: skip
        ours = next((point for point in one["ours"] if point["duality_gap"] <= 1e-3), None)
        rows.append([
            world, f"{one['templates']:,}", f"{one['initial']:.4f}", f"{one['lower_bound']:.6f}",
            f"{one['algorithm2'][-1]:.6f}", "never" if within is None else str(within),
            "never" if ours is None else str(ours["iterations"]),
        ])  # fmt: skip
    head = ["world", "template frames", "at W = 0", "lower bound", "Algorithm 2, last", "its iterations to 1e-3",
            "ours to 1e-3"]  # fmt: skip
    yield html.table(head, rows, left=1)


def _method(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Iterator[str]:
    width, height = plan.camera
    yield "<h2>Conditions</h2>"
    yield (
        f"<p>Simulated camera of {width}x{height} pixels, 10 frames a second, lockstep, driven wheels with mass. "
        f"Seeds: teaching {TEACHING_SEED} and following, held-out drives {QUERY_SEED} and following, searches "
        f"{RUN_SEED} and following (of another purpose, so that starts differ from those of teaching). A search ends "
        f"with the victim found, a collision, or after {plan.max_ticks} frames. Teaching is never degraded. "
        f"Features: colour and HOG, the default. Same seeds give the same results on one machine.</p>"
    )
    rows = []
    for world in plan.worlds:
        taught = [store.findings[unit.key] for unit in units if unit.kind == "teach" and unit.world == world.world]
        learned = {unit.number("length"): store.findings[unit.key]
                   for unit in units if unit.kind == "learn" and unit.world == world.world}  # fmt: skip
        states = ", ".join(f"{one['states']} (l = {length})" for length, one in learned.items())
        rows.append([
            world.world, f"{world.drives} + {world.recoveries} recoveries", str(sum(one["drives"] for one in taught)),
            f"{sum(one['frames'] for one in taught):,}", states,
        ])  # fmt: skip
    yield html.table(["world", "drives", "that teach", "frames", "states learned"], rows, left=1)
    kinds = dict.fromkeys(unit.kind for unit in units)
    spent = {kind: _seconds([unit for unit in units if unit.kind == kind], store.findings) for kind in kinds}
    times = ", ".join(f"{kind} {seconds:.0f} s" for kind, seconds in spent.items())
    yield (
        f"<p>Processor time: {times}. Machine: {escape(platform.processor() or platform.machine())}, "
        f"{escape(platform.system())}, Python {platform.python_version()}. Plan {plan.fingerprint}, version "
        f"{program_version()}.</p>"
    )
