"""What the report says of each world, as HTML: recognition, searches, errands, an example."""

from collections.abc import Callable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from schemas.episode import Outcome
from services.experiments import html
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.drives import load_arrays
from services.experiments.evaluation.errands import TASKS
from services.experiments.evaluation.plan import CONTROLLERS, JUDGED_TICKS
from services.experiments.evaluation.report import figures
from services.experiments.evaluation.report.summary import SOON_S, Success, WorldResults
from services.experiments.words import counted
from smal.evaluation.success import wilson_interval

#: How searches end that do not find the victim, and what that is called.
SHOWN: Final[dict[Outcome, str]] = {
    "collision": "collisions", "timeout": "out of time", "missed": "missed", "false_goal": "false goals",
    "not_here": "“not here”",
}  # fmt: skip

Put = Callable[[str, Figure, str], str]  # Name, figure and caption (HTML) to HTML.


def recognition_section(found: WorldResults, put: Put) -> Iterator[str]:
    """Write it, piece by piece."""
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


def search_section(found: WorldResults, examples: Sequence[Path], put: Put) -> Iterator[str]:
    """Write it, piece by piece; the files are those of examples."""
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
        yield from _errands(found)
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


def _errands(found: WorldResults) -> Iterator[str]:
    rows = []
    for name, one in found.errands.items():
        right, runs = one["outcomes"].count("found"), len(one["outcomes"])
        rows.append([
            name, TASKS[name].meaning, f"{right} of {runs}", _interval(wilson_interval(right, runs), ".0%"),
            f"{sum(one['driven_m']) / runs:.0f}", ", ".join(f"{way:.0f}" for way in one["taught_m"]),
        ])  # fmt: skip
    yield "<h3>Errands</h3>"
    yield "<p>What several drives together make possible: SMAL, each drive taught once, from untaught starts.</p>"
    yield html.table(["errand", "what", "right", "95 %", "driven m, mean", "taught drives, m"], rows, left=2)


def _interval(ends: tuple[float, float], form: str) -> str:
    return f"{ends[0]:{form}} to {ends[1]:{form}}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
