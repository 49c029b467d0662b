"""The page of an evaluation: one HTML file that needs nothing beside it, and beside it every figure and number."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from services.experiments import html
from services.experiments.evaluation.plan import DEFAULT_LENGTH, QUERY_SEED, RUN_SEED, TEACHING_SEED, Plan
from services.experiments.evaluation.report.comparisons import Comparison, comparisons
from services.experiments.evaluation.report.figure_style import embed
from services.experiments.evaluation.report.numbers import as_json
from services.experiments.evaluation.report.recognition_section import objective_section, recognition_section
from services.experiments.evaluation.report.search_section import search_section
from services.experiments.evaluation.report.summary import results_of
from services.experiments.evaluation.results import Finding, ResultStore
from services.experiments.evaluation.schedule import Unit, whole_series
from services.experiments.evaluation.search import MAX_TICKS
from services.kit.version import program_version

_VERDICT: Final = {"ahead": "yes", "behind": "no", "open": "not shown", "counts": "-"}


def write_page(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Path:
    """Write ``index.html``, ``results.json`` and the figures into the folder of the results.

    Parameters
    ----------
    plan, units
        What is to be run, all of it.
    store
        What was found out. Where that is not all, the page says so, and shows every series that is whole.

    Returns
    -------
    Path
        Of the page.
    """
    planned, done = len(units), sum(unit.key in store.findings for unit in units)
    units = whole_series(units, store.findings)
    found = [results_of(world, units, store.findings) for world in plan.worlds]
    compared = [one for each in found for one in comparisons(each)]
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "units": {"planned": planned, "done": done, "shown": len(units)},
        "machine_seconds": _seconds(units, store.findings),
        "comparisons": [{"world": c.world, "verdict": c.verdict, "text": c.text} for c in compared],
        "worlds": as_json(found),
    }
    (store.folder / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    figures = store.folder / "figures"
    figures.mkdir(exist_ok=True)
    put = partial(embed, figures)
    body = [*_introduction(plan, units, store)]
    if done < planned:
        body.append(
            f"<p><b>Not all is done:</b> {done:,} of {planned:,} units. What is shown is whole, with all of its runs; "
            "the rest is left out until it is.</p>"
        )
    body += _summary(compared)
    for each in found:
        body.append(f"<h2>{escape(each.world.title.capitalize())}</h2>")
        if each.recognized[0]:
            body += recognition_section(each, put)
        if each.successes:
            body += search_section(each, store, put)
    body += [*objective_section(found, put), *_method(plan, units, store)]
    path = store.folder / "index.html"
    path.write_text(html.page(f"SMAL: evaluation in simulation ({plan.name})", "\n".join(body), 72), encoding="utf-8")
    return path


def _seconds(units: Sequence[Unit], findings: Mapping[str, Finding]) -> float:
    return round(sum(float(findings[unit.key]["cpu_s"]) for unit in units), 1)


def _introduction(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Iterator[str]:
    seconds = _seconds(units, store.findings)
    time = f"{seconds / 3600:.1f} h" if seconds > 7200 else f"{seconds / 60:.0f} min"
    yield (
        "<p>The experiments of Han, Yang, Zhang and Zhang, <em>Sequence-based Multimodal Apprenticeship Learning for "
        "Robot Perception and Decision Making</em> (ICRA 2017), repeated in simulation, and taken further. A scripted "
        "expert drives the robot to a victim; from camera images, keys and odometry SMAL learns a map of views, and "
        "the paper's scheme states, actions, transitions and a reward; then the robot searches by itself from other "
        "starts.</p>"
    )
    if plan.omitted:
        yield f"<p><b>This is the quick evaluation.</b> It leaves out: {'; '.join(map(escape, plan.omitted))}.</p>"
    searches = sum(unit.kind == "search" for unit in units)
    queries = sum(int(store.findings[unit.key]["frames"]) for unit in units if unit.kind == "queries")
    yield html.tiles(
        {
            "worlds": ", ".join(world.title for world in plan.worlds),
            "searches": str(searches),
            "held-out frames": f"{queries:,}",
            "processor time": time,
            "version": program_version(),
        }
    )


def _summary(compared: Iterable[Comparison]) -> Iterator[str]:
    yield "<h2>In words</h2>"
    yield (
        f"<p>In searches SMAL, in recognition Eq. 9 (l = {DEFAULT_LENGTH}), against each other method; “ahead” and "
        "“behind” only where the 95 % interval of the difference of areas leaves out zero, or the exact sign test on "
        "the same seeds has p below 0.05; with fewer than six searches it never has. Of so many comparisons one in "
        "twenty would come out so by chance. All of it is computed from the results below.</p>"
    )
    rows = [
        f'<tr><td class="text">{escape(one.world)}</td><td class="text">{escape(one.text)}</td>'
        f'<td class="text {one.verdict}">{_VERDICT[one.verdict]}</td></tr>'
        for one in compared
    ]
    head = '<tr><th class="text">world</th><th class="text">result</th><th class="text">ahead?</th></tr>'
    yield f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _method(plan: Plan, units: Sequence[Unit], store: ResultStore) -> Iterator[str]:
    width, height = plan.camera
    yield "<h2>Conditions</h2>"
    yield (
        f"<p>Simulated camera of {width}x{height} pixels, 10 frames a second, lockstep, driven wheels with mass. "
        f"Seeds: teaching {TEACHING_SEED} and following, held-out drives {QUERY_SEED} and following, searches "
        f"{RUN_SEED} and following (of another purpose, so that starts differ from those of teaching). A search ends "
        f"with the victim found, a collision, the robot's word that it has arrived, or after {plan.patience:g} times "
        f"the frames of the longest taught drive (in smal run at least {MAX_TICKS}): a robot that is slow fails as one "
        f"that is lost does. Teaching is never degraded. SPL is success weighted by path length (Anderson et al. "
        f"2018); aside is the distance from the taught ways, by the truth; wrong and sure are frames at which the "
        f"robot believes to be further from the truth than the first criterion allows, and not to be lost. "
        f"Features: colour and HOG, the default. Same seeds give the same results on one machine.</p>"
    )
    rows = []
    for world in plan.worlds:
        taught = [store.findings[unit.key] for unit in units if unit.kind == "teach" and unit.world == world.world]
        learned = {(unit.number("drives"), unit.number("length")): store.findings[unit.key]
                   for unit in units if unit.kind == "learn" and unit.world == world.world}  # fmt: skip
        states = ", ".join(f"{one['states']} ({n} drives, l = {length})" for (n, length), one in learned.items())
        rows.append([world.title, str(len(taught)), f"{sum(one['frames'] for one in taught):,}", states])
    yield html.table(["world", "drives", "frames", "states learned"], rows, left=1)
    kinds = dict.fromkeys(unit.kind for unit in units)
    spent = {kind: _seconds([unit for unit in units if unit.kind == kind], store.findings) for kind in kinds}
    times = ", ".join(f"{kind} {seconds:.0f} s" for kind, seconds in spent.items())
    yield (
        f"<p>Processor time: {times}. Machine: {escape(platform.processor() or platform.machine())}, "
        f"{escape(platform.system())}, Python {platform.python_version()}. Plan {plan.fingerprint}, version "
        f"{program_version()}.</p>"
    )
