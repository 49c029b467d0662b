"""The page of an evaluation: one HTML file that needs nothing beside it, and beside it every figure and number."""

import json
import math
import platform
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from schemas.episode import Outcome
from services.experiments import html
from services.experiments.drawing import COLOURS, TEXT, look_at, styled
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.drives import load_arrays
from services.experiments.evaluation.errands import TASKS
from services.experiments.evaluation.plan import (
    CONTROLLERS,
    DEFAULT_LENGTH,
    JUDGED_TICKS,
    QUERY_SEED,
    RUN_SEED,
    TEACHING_SEED,
    EvaluationPlan,
)
from services.experiments.evaluation.report.summary import (
    SOON_S,
    Recognized,
    Success,
    WorldResults,
    results_of,
)
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import (
    LearnUnit,
    Query,
    Searches,
    Teach,
    code_fingerprint,
    units,
)
from services.experiments.words import counted
from services.kit.jpeg import decode_jpeg
from services.kit.model_service import LEAST_TICKS
from services.kit.version import program_version
from services.robot.clock import TICK_S
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map
from smal.evaluation.precision_recall import wilson_interval
from smal.files.container import write_whole

_DPI: Final = 130
#: How searches end that do not find the victim, and what that is called.
SHOWN: Final[dict[Outcome, str]] = {
    "collision": "collisions", "timeout": "out of time", "missed": "missed", "false_goal": "false goals",
    "not_here": "“not here”",
}  # fmt: skip

Put = Callable[[str, Figure, str], str]  # Name, figure and caption (HTML) to HTML.
#: Of who searches and who recognizes, beside ours and the single image.
_PEERS: Final = {
    "smal": COLOURS[0], "paper": COLOURS[1], "teach-and-repeat": "#e09f3e", "teach-and-repeat-told": "#b5651d",
    "nearest-1": "#8d99ae", "nearest-5": "#5c677d", "smal-waits": "#7aa6c2", "smal-unguarded": "#999999",
}  # fmt: skip
VIEWS: Final = 6  # Camera images beside an example route.


def write_page(plan: EvaluationPlan, results: Results) -> Path:
    """Write ``index.html``, ``results.json`` and the figures of all units that are done; return the page."""
    planned = units(plan)
    findings = results.findings
    found = [results_of(world, planned, findings) for world in plan.worlds]
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "units": {"planned": len(planned), "done": len(findings)},
        "machine_seconds": round(_seconds(results), 1),
        "worlds": {one.world.title: one.as_json() for one in found},
    }
    write_whole(results.folder / "results.json", (json.dumps(numbers, indent=1) + "\n").encode())
    put = partial(embed, results.folder / "figures")
    body = list(_introduction(plan, results))
    if len(findings) < len(planned):
        body.append(
            f"<p><b>Not all is done:</b> {len(findings):,} of {len(planned):,} units (drives, models, searches). What "
            "is shown is whole, with all of its runs; the rest is left out until it is.</p>"
        )
    for each in found:
        body.append(f"<h2>{escape(each.world.title.capitalize())}</h2>")
        if each.recognized:
            body += _recognition(each, put)
        if each.successes:
            here = [
                one
                for one in findings
                if one.site.world == each.world.world and findings[one].get("file")
            ]
            body += _finding(
                each, [one.file(results.work) for one in here if isinstance(one, Searches)], put
            )
    body += _method(plan, results)
    return html.write_page(results.folder, f"SMAL: evaluation in simulation ({plan.name})", body)


def embed(folder: Path, name: str, figure: Figure, caption: str) -> str:
    """Write a figure as ``NAME.png``, and return it as HTML with its caption, which is HTML too."""
    data = html.png(figure, _DPI)
    folder.mkdir(exist_ok=True)
    write_whole(folder / f"{name}.png", data)
    return (
        f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'
    )


def _seconds(results: Results) -> float:
    return sum(float(found["cpu_s"]) for found in results.findings.values())


def _introduction(plan: EvaluationPlan, results: Results) -> Iterator[str]:
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
            "searches": str(
                sum(len(found[one]["searches"]) for one in found if isinstance(one, Searches))
            ),
            "held-out frames": f"{sum(found[one]['frames'] for one in found if isinstance(one, Query)):,}",
            "processor time": f"{_seconds(results) / 60:.0f} min",
            "version": program_version(),
        }
    )


def _recognition(found: WorldResults, put: Put) -> Iterator[str]:
    name = found.world.title
    scene = "the indoor search" if name == "indoor" else "the urban search"
    world = found.world
    views = "; ".join(
        f"<b>{name}</b>: {escape(DEGRADATIONS[name].meaning)}" for name in world.recognized
    )
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
        precision_recall(found.recognized, f"State recognition, {name}"),
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
    head = [
        "method",
        "view",
        "area",
        "95 %",
        "recall at 100 % precision",
        "95 %",
        "frames with a right answer",
    ]
    yield html.table(head, rows, left=2)


def _finding(found: WorldResults, examples: Sequence[Path], put: Put) -> Iterator[str]:
    name = found.world.title
    successes = found.successes
    yield "<h3>Finding the victim</h3>"
    if any(one.trial.condition == "as taught" for one in successes):
        yield put(
            f"drives-{name}",
            found_by_drives(successes, f"Searches that find the victim, {name}"),
            "The same drives and starts for all; the paper's scheme has five recoveries a drive as well. Bars are "
            "Wilson's 95 % intervals. Starts were not used in teaching.",
        )
    if len({one.trial.length for one in successes if one.trial.controller == "paper"}) > 1:
        yield put(
            f"success-{name}",
            success_by_length(successes, f"Success over sequence length, {name}"),
            "Share of searches that find the victim without a collision, over l, by the paper's scheme (its figure of "
            "success rates in its parameter analysis). With l = 1 it is the single image.",
        )
    yield from _searches(successes)
    if found.errands:
        rows = []
        for task, one in found.errands.items():
            right = one["outcomes"].count("found")
            runs = len(one["outcomes"])
            rows.append([
                task, TASKS[task].meaning, f"{right} of {runs}", _interval(wilson_interval(right, runs), ".0%"),
                f"{sum(one['driven_m']) / runs:.0f}", ", ".join(f"{way:.0f}" for way in one["taught_m"]),
            ])  # fmt: skip
        yield "<h3>Errands</h3>"
        yield "<p>What several drives together make possible: SMAL, each drive taught once, from untaught starts.</p>"
        yield html.table(
            ["errand", "what", "right", "95 %", "driven m, mean", "taught drives, m"], rows, left=2
        )
    yield "<h3>An example</h3>"
    if not examples:
        yield "<p>No search of SMAL found the victim: no example.</p>"
        return
    yield put(
        f"route-{name}",
        example_route(found.world.world, load_arrays(examples[0]), f"A search in the world {name}"),
        "The way of a successful search from a start that was not taught (arrow) to the victim (star), and what the "
        "camera saw at the numbered places (the paper's figures of route and observations).",
    )


def _searches(found: Sequence[Success]) -> Iterator[str]:
    usual = [one for one in found if one.trial.condition == "as taught"]
    special = sorted(
        (one for one in found if one not in usual),
        key=lambda one: (one.trial.condition, one.trial.title),
    )
    rows = [
        [
            one.trial.condition, str(one.trial.drives), one.trial.title, one.said, _interval(one.wilson_95, ".0%"),
            *(str(one.outcomes.count(outcome)) for outcome in SHOWN),
            _or_dash(one.spl, ".2f"), f"{one.aside_rms_m:.2f}", f"{one.aside_max_m:.2f}",
            f"{one.clearance_p5_m:.2f}", _or_dash(one.turns_per_m, ".2f"), f"{one.jerk_m_s3:.1f}",
            _or_dash(one.time_over_taught, ".2f"),
            _or_dash(one.interventions_per_km, ".1f"), _or_dash(one.wrong_share, ".1%"),
            "-" if one.right_soon is None else "{} of {}".format(*one.right_soon),
        ]
        for one in [*sorted(usual, key=lambda one: one.trial.drives), *special]
    ]  # fmt: skip
    yield html.table(
        ["condition", "drives", "driver", "found", "95 %", *SHOWN.values(), "SPL",
         "aside, RMS m", "max m", "clearance, 5 % m", "turns a m", "jerk, m/s³", "time over taught",
         "interventions a km", "wrong and sure", f"right within {SOON_S:g} s"],
        rows, left=3,
    )  # fmt: skip
    yield "<p>" + "; ".join(f"{name}: {how}" for name, how in CONTROLLERS.values()) + ".</p>"


def _interval(ends: tuple[float, float], form: str) -> str:
    return f"{ends[0]:{form}} to {ends[1]:{form}}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _method(plan: EvaluationPlan, results: Results) -> Iterator[str]:
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
        f"2018); aside is the distance from the taught ways, by the truth; clearance that from the robot's side to "
        f"the nearest thing or person, the 5th percentile over the frames of a search, the mean over searches; a turn "
        f"is counted where the robot begins to turn to a side at half its turn rate or more; jerk is the root mean "
        f"square of third differences of the true place, 10 a second; time over taught is that of the searches that "
        f"found over that of the mean taught drive; wrong and sure are frames at which the "
        f"robot believes to be further from the truth than the criterion allows, and not to be lost. "
        f"Features: colour and HOG, the default. Same seeds give the same results on one machine.</p>"
    )
    rows = []
    for world in plan.worlds:
        here = {
            unit: found
            for unit, found in results.findings.items()
            if unit.site.world == world.world
        }
        frames = [found["frames"] for unit, found in here.items() if isinstance(unit, Teach)]
        states = ", ".join(f"{here[one]['states']} ({counted(len(one.needs), 'drive')}, l = {one.length})"
                           for one in here if isinstance(one, LearnUnit) and one.length)  # fmt: skip
        rows.append([world.title, str(len(frames)), f"{sum(frames):,}", states])
    yield html.table(["world", "drives", "frames", "states learned"], rows, left=1)
    yield (
        f"<p>Machine: {escape(platform.processor() or platform.machine())}, {escape(platform.system())}, Python "
        f"{platform.python_version()}. Version {program_version()}, code {code_fingerprint()[:12]}.</p>"
    )


def _panels(
    count: int, width: float, height: float, title: str, *, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side, inches wide and high each."""
    drawn = Figure(figsize=(width * count, height))
    drawn.suptitle(title)
    return drawn, list(drawn.subplots(1, count, squeeze=False, sharey=sharey)[0])


def _views(degradations: Iterable[str]) -> dict[str, str]:
    """Return each degradation once, with what is seen under it, no wider than its axes."""
    return {
        name: "clear view" if name == "clean" else textwrap.fill(DEGRADATIONS[name].meaning, 46)
        for name in dict.fromkeys(degradations)
    }


@styled
def precision_recall(found: Sequence[Recognized], title: str) -> Figure:
    """Draw Eq. 9, darker the longer its sequences, and the peers, dashed; a panel for each degradation."""
    views = _views(one.degradation for one in found)
    lengths = {one.recognizer.length for one in found}
    drawn, panels = _panels(len(views), 5.2, 5.4, title)
    least = min((float(one.curve.precision.min(initial=1.0)) for one in found), default=0.0)
    floor = max(0.0, math.floor(10.0 * least - 2.0) / 10.0)
    for axes, (degradation, said) in zip(panels, views.items(), strict=True):
        for one in (each for each in found if each.degradation == degradation):
            recall = np.concatenate([[0.0], one.curve.recall])  # Steps, as the area counts them.
            precision = np.concatenate([one.curve.precision[:1], one.curve.precision])
            label = f"{one.recognizer.title}  (area {one.curve.auc:.3f})"
            length = one.recognizer.length
            shade = mpl.colormaps["viridis_r"](
                0.12 + 0.83 * sorted(lengths).index(length) / len(lengths)
            )
            colour, dashes = (
                (shade, "-") if one.recognizer.eq9 else (_PEERS[f"nearest-{length}"], "--")
            )
            axes.step(
                recall[: precision.size],
                precision,
                where="pre",
                label=label,
                color=colour,
                ls=dashes,
                lw=2.2,
            )
        axes.set(
            xlim=(0, 1.015),
            ylim=(floor, 1.0 + 0.03 * (1.0 - floor)),
            xlabel="recall",
            ylabel="precision",
        )
        axes.set_title(said)
        axes.legend(loc="lower left")
    return drawn


@styled
def found_by_drives(found: Sequence[Success], title: str) -> Figure:
    """Draw the share of searches that find the victim over the number of taught drives, for everybody."""
    usual = [one for one in found if one.trial.condition == "as taught"]
    counts = sorted({one.trial.drives for one in usual})
    names = [name for name in CONTROLLERS if any(one.trial.controller == name for one in usual)]
    drawn, (axes,) = _panels(1, 9.0, 4.6, title)
    width = 0.84 / len(names)
    for number, name in enumerate(names):
        for one in usual:
            if one.trial.controller != name or one.trial.length != DEFAULT_LENGTH:
                continue
            place = counts.index(one.trial.drives)
            at = place + (number - (len(names) - 1) / 2) * width
            axes.bar(
                at,
                one.rate,
                0.9 * width,
                color=_PEERS[name],
                label=None if place else one.trial.title,
            )
            axes.plot([at, at], one.wilson_95, color=TEXT, lw=1.0)
            axes.text(at, 1.04, f"{one.found}/{one.runs}", ha="center", fontsize=6)
    axes.set_xticks(range(len(counts)), [str(count) for count in counts])
    axes.set(ylim=(0.0, 1.12), xlabel="taught drives", ylabel="searches that find the victim")
    drawn.legend(loc="outside lower center", ncols=3)
    return drawn


@styled
def success_by_length(found: Sequence[Success], title: str) -> Figure:
    """Draw the success rate of the paper's scheme over l, with Wilson's intervals, a panel for each degradation."""
    every = [one for one in found if one.trial.controller == "paper"]
    most = max(one.trial.drives for one in every if one.trial.length != DEFAULT_LENGTH)
    paper = sorted(
        (one for one in every if one.trial.drives == most), key=lambda one: one.trial.length
    )
    views = _views(one.trial.degradation for one in paper)
    ticks = sorted({one.trial.length for one in paper})
    drawn, panels = _panels(len(views), 5.6, 4.2, title, sharey=True)
    for axes, (degradation, said) in zip(panels, views.items(), strict=True):
        each = [one for one in paper if one.trial.degradation == degradation]
        rates = np.array([one.rate for one in each])
        (low, high) = np.array([one.wilson_95 for one in each]).T
        around = np.maximum([rates - low, high - rates], 0.0)
        at = [ticks.index(one.trial.length) for one in each]
        axes.errorbar(
            at, rates, around, lw=2, capsize=4, elinewidth=1.2, color=_PEERS["paper"], marker="s"
        )
        axes.set_xticks(range(len(ticks)), [str(length) for length in ticks])
        axes.set(
            ylim=(-0.03, 1.05), title=said, xlabel=f"sequence length l (frames), {most} drives"
        )
    panels[0].set_ylabel("searches that found the victim")
    return drawn


@styled
def example_route(world: str, route: Mapping[str, NDArray[Any]], title: str) -> Figure:
    """Draw the way of a search, its ``poses``, on the map, and what the camera saw along it, by ticks."""
    poses = route["poses"]
    ticks = sorted(int(name) for name in route if name.isdigit())
    chosen = [
        ticks[k] for k in np.linspace(0, len(ticks) - 1, min(VIEWS, len(ticks))).round().astype(int)
    ]
    drawn = Figure(figsize=(15.0, 8.1))
    drawn.suptitle(title)
    grid = drawn.add_gridspec(2, len(chosen), height_ratios=[3.2, 1.0])
    above = drawn.add_subplot(grid[0, :])
    there = load_world(world)
    draw_map(there, above)
    above.plot(*poses[:, :2].T, color=COLOURS[2], lw=2.4, zorder=4)
    look_at(above, np.vstack([poses[:, :2], [there.victim.x, there.victim.y]]), there.place.bounds)
    for column, tick in enumerate(chosen):
        above.annotate(str(column + 1), poses[tick, :2].tolist(), fontsize=9, ha="center", va="center", zorder=6,
                       bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": COLOURS[2], "lw": 1.2})  # fmt: skip
        axes = drawn.add_subplot(grid[1, column])
        axes.imshow(decode_jpeg(route[str(tick)].tobytes()))
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{column + 1}: after {tick * TICK_S:.0f} s")
        axes.grid(visible=False)
    return drawn
