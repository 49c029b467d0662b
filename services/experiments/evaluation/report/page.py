"""The page of an evaluation: one HTML file that needs nothing beside it, and beside it every figure and number."""

import json
import platform
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from schemas.episode import Outcome
from services.experiments import html
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.drives import load_arrays
from services.experiments.evaluation.errands import TASKS
from services.experiments.evaluation.plan import CONTROLLERS, JUDGED_TICKS, QUERY_SEED, RUN_SEED, TEACHING_SEED, Plan
from services.experiments.evaluation.report import figures
from services.experiments.evaluation.report.summary import SOON_S, Success, WorldResults, results_of
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import Learn, Query, Searches, Teach, code_fingerprint, units
from services.experiments.words import counted
from services.kit.model_service import LEAST_TICKS
from services.kit.version import program_version
from smal.evaluation.precision_recall import wilson_interval

_DPI: Final = 130
#: How searches end that do not find the victim, and what that is called.
SHOWN: Final[dict[Outcome, str]] = {
    "collision": "collisions", "timeout": "out of time", "missed": "missed", "false_goal": "false goals",
    "not_here": "“not here”",
}  # fmt: skip

Put = Callable[[str, Figure, str], str]  # Name, figure and caption (HTML) to HTML.


def write_page(plan: Plan, results: Results) -> Path:
    """Write ``index.html``, ``results.json`` and the figures of all units that are done; return the page."""
    planned, findings = units(plan), results.findings
    found = [results_of(world, planned, findings) for world in plan.worlds]
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "units": {"planned": len(planned), "done": len(findings)},
        "machine_seconds": round(_seconds(results), 1),
        "worlds": {one.world.title: one.as_json() for one in found},
    }
    (results.folder / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    put = partial(embed, results.folder / "figures")
    body = list(_introduction(plan, results))
    if len(findings) < len(planned):
        body.append(
            f"<p><b>Not all is done:</b> {len(findings):,} of {len(planned):,} units. What is shown is whole, with all "
            "of its runs; the rest is left out until it is.</p>"
        )
    for each in found:
        body.append(f"<h2>{escape(each.world.title.capitalize())}</h2>")
        if each.recognized:
            body += _recognition(each, put)
        if each.successes:
            here = [one for one in findings if one.site.world == each.world.world and findings[one].get("file")]
            body += _finding(each, [one.file(results.work) for one in here if isinstance(one, Searches)], put)
    body += _method(plan, results)
    return html.write_page(results.folder, f"SMAL: evaluation in simulation ({plan.name})", body)


def embed(folder: Path, name: str, figure: Figure, caption: str) -> str:
    """Write a figure as ``NAME.png``, and return it as HTML with its caption, which is HTML too."""
    data = html.png(figure, _DPI)
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.png").write_bytes(data)
    return f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'


def _seconds(results: Results) -> float:
    return sum(float(found["cpu_s"]) for found in results.findings.values())


def _introduction(plan: Plan, results: Results) -> Iterator[str]:
    yield (
        "<p>The experiments of Han, Yang, Zhang and Zhang, <em>Sequence-based Multimodal Apprenticeship Learning for "
        "Robot Perception and Decision Making</em> (ICRA 2017), repeated in simulation, and taken further. A scripted "
        "expert drives the robot to a victim; from camera images, keys and odometry SMAL learns a map of views, and "
        "the paper's scheme states, actions, transitions and a reward; then the robot searches by itself from other "
        "starts.</p>"
    )
    if plan.omitted:
        yield f"<p><b>This is the quick evaluation.</b> It leaves out: {'; '.join(map(escape, plan.omitted))}.</p>"
    found = results.findings
    yield html.tiles(
        {
            "worlds": ", ".join(world.title for world in plan.worlds),
            "searches": str(sum(len(found[one]["searches"]) for one in found if isinstance(one, Searches))),
            "held-out frames": f"{sum(found[one]['frames'] for one in found if isinstance(one, Query)):,}",
            "processor time": f"{_seconds(results) / 60:.0f} min",
            "version": program_version(),
        }
    )


def _recognition(found: WorldResults, put: Put) -> Iterator[str]:
    name = found.world.title
    scene = "the indoor search" if name == "indoor" else "the urban search"
    world = found.world
    views = "; ".join(f"<b>{name}</b>: {escape(DEGRADATIONS[name].meaning)}" for name in world.recognized)
    yield (
        "<h3>Recognizing where the robot is</h3><p><b>One criterion for all methods:</b> an answer is right if the "
        "demonstrated frame that the method takes the robot to be at was taken "
        f"{escape(world.criterion.meaning)} of the robot's true pose. For Eq. 9 that "
        "is the frame of the best sequence at which W places the robot. The score is the weight of that sequence, for "
        "each frame; for the nearest frames the mean cosine. Recall counts all frames that have a right answer among "
        "the demonstrations. "
        f"Queries are one in {JUDGED_TICKS} frames of {counted(world.queries, 'held-out drive')}, the same for "
        f"all methods: those from frame {world.first_judged_tick} of a drive on, from which every method has a whole "
        "window. Bars and intervals are of a block bootstrap over the held-out frames. Recall at 100 % precision is "
        "decided by the surest wrong answer alone, which a third of the draws lack: its interval covers less than "
        f"95 %. Views: {views}.</p>"
    )
    yield put(
        f"precision-recall-{name}",
        figures.precision_recall(found.recognized, f"State recognition, {name}"),
        "Precision over recall as the score's threshold falls, as in the paper's figures of precision-recall curves of "
        f"{scene} and of its parameter analysis. Closer to the top right is better.",
    )
    rows = [
        [
            one.recognizer.title, one.degradation, f"{one.curve.auc:.3f}", _interval(one.intervals.auc, ".3f"),
            f"{one.curve.recall_at_100_precision:.3f}", _interval(one.intervals.recall_at_100_precision, ".3f"),
            f"{int(one.judgement.findable.sum())} of {one.judgement.score.size}",
        ]
        for one in found.recognized
    ]  # fmt: skip
    head = ["method", "view", "area", "95 %", "recall at 100 % precision", "95 %", "frames with a right answer"]
    yield html.table(head, rows, left=2)


def _finding(found: WorldResults, examples: Sequence[Path], put: Put) -> Iterator[str]:
    name, successes = found.world.title, found.successes
    yield "<h3>Finding the victim</h3>"
    if any(one.trial.condition == "as taught" for one in successes):
        yield put(
            f"drives-{name}",
            figures.found_by_drives(successes, f"Searches that find the victim, {name}"),
            "The same drives and starts for all; the paper's scheme has five recoveries a drive as well. Bars are "
            "Wilson's 95 % intervals. Starts were not used in teaching.",
        )
    if len({one.trial.length for one in successes if one.trial.controller == "paper"}) > 1:
        yield put(
            f"success-{name}",
            figures.success_by_length(successes, f"Success over sequence length, {name}"),
            "Share of searches that find the victim without a collision, over l, by the paper's scheme (its figure of "
            "success rates in its parameter analysis). With l = 1 it is the single image.",
        )
    yield from _searches(successes)
    if found.errands:
        rows = []
        for task, one in found.errands.items():
            right, runs = one["outcomes"].count("found"), len(one["outcomes"])
            rows.append([
                task, TASKS[task].meaning, f"{right} of {runs}", _interval(wilson_interval(right, runs), ".0%"),
                f"{sum(one['driven_m']) / runs:.0f}", ", ".join(f"{way:.0f}" for way in one["taught_m"]),
            ])  # fmt: skip
        yield "<h3>Errands</h3>"
        yield "<p>What several drives together make possible: SMAL, each drive taught once, from untaught starts.</p>"
        yield html.table(["errand", "what", "right", "95 %", "driven m, mean", "taught drives, m"], rows, left=2)
    yield "<h3>An example</h3>"
    if not examples:
        yield "<p>No search of SMAL found the victim: no example.</p>"
        return
    yield put(
        f"route-{name}",
        figures.example_route(found.world.world, load_arrays(examples[0]), f"A search in the world {name}"),
        "The way of a successful search from a start that was not taught (arrow) to the victim (star), and what the "
        "camera saw at the numbered places (the paper's figures of route and observations).",
    )


def _searches(found: Sequence[Success]) -> Iterator[str]:
    usual = [one for one in found if one.trial.condition == "as taught"]
    special = sorted((one for one in found if one not in usual), key=lambda one: (one.trial.condition, one.trial.title))
    rows = [
        [
            one.trial.condition, str(one.trial.drives), one.trial.title, one.said, _interval(one.wilson_95, ".0%"),
            *(str(one.outcomes.count(outcome)) for outcome in SHOWN),
            _or_dash(one.spl, ".2f"), f"{one.aside_rms_m:.2f}", f"{one.aside_max_m:.2f}",
            _or_dash(one.interventions_per_km, ".1f"), _or_dash(one.wrong_share, ".1%"),
            "-" if one.right_soon is None else "{} of {}".format(*one.right_soon),
        ]
        for one in [*sorted(usual, key=lambda one: one.trial.drives), *special]
    ]  # fmt: skip
    yield html.table(
        ["condition", "drives", "driver", "found", "95 %", *SHOWN.values(), "SPL",
         "aside, RMS m", "max m", "interventions a km", "wrong and sure", f"right within {SOON_S:g} s"],
        rows, left=3,
    )  # fmt: skip
    yield "<p>" + "; ".join(f"{name}: {how}" for name, how in CONTROLLERS.values()) + ".</p>"


def _interval(ends: tuple[float, float], form: str) -> str:
    return f"{ends[0]:{form}} to {ends[1]:{form}}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _method(plan: Plan, results: Results) -> Iterator[str]:
    width, height = plan.camera
    yield "<h2>Conditions</h2>"
    yield (
        f"<p>Simulated camera of {width}x{height} pixels, 10 frames a second, lockstep, driven wheels with mass. "
        f"Seeds: teaching {TEACHING_SEED} and following, held-out drives {QUERY_SEED} and following, searches "
        f"{RUN_SEED} and following (of another purpose, so that starts differ from those of teaching). A search ends "
        f"with a collision, the robot's word (found: false where the victim is not near and in view; or not here), for "
        f"drivers that say nothing with the victim found, or after {plan.patience:g} times "
        f"the frames of the longest taught drive (in smal run at least {LEAST_TICKS}): a slow robot fails as one "
        f"that is lost does. Teaching is never degraded. SPL is success weighted by path length (Anderson et al. "
        f"2018); aside is the distance from the taught ways, by the truth; wrong and sure are frames at which the "
        f"robot believes to be further from the truth than the criterion allows, and not to be lost. "
        f"Features: colour and HOG, the default. Same seeds give the same results on one machine.</p>"
    )
    rows = []
    for world in plan.worlds:
        here = {unit: found for unit, found in results.findings.items() if unit.site.world == world.world}
        frames = [found["frames"] for unit, found in here.items() if isinstance(unit, Teach)]
        states = ", ".join(f"{here[one]['states']} ({counted(len(one.needs), 'drive')}, l = {one.length})"
                           for one in here if isinstance(one, Learn) and one.length)  # fmt: skip
        rows.append([world.title, str(len(frames)), f"{sum(frames):,}", states])
    yield html.table(["world", "drives", "frames", "states learned"], rows, left=1)
    yield (
        f"<p>Machine: {escape(platform.processor() or platform.machine())}, {escape(platform.system())}, Python "
        f"{platform.python_version()}. Version {program_version()}, code {code_fingerprint()[:12]}.</p>"
    )
