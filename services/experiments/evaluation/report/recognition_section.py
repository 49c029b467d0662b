"""What the report says of recognition: precision and recall of every method in a world; how fast matching converges."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from html import escape

from matplotlib.figure import Figure

from services.experiments import html
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.plan import JUDGED_TICKS, WorldPlan
from services.experiments.evaluation.report import figures
from services.experiments.evaluation.report.summary import Recognized, WorldResults

#: Name, figure and caption (HTML) to HTML.
Put = Callable[[str, Figure, str], str]


def recognition_section(found: WorldResults, put: Put) -> Iterator[str]:
    """Write it as HTML, piece by piece."""
    world = found.world
    name = world.title
    yield f"<h3>Recognizing where the robot is</h3>{_criterion(world)}"
    yield put(
        f"precision-recall-{name}",
        figures.precision_recall(found.recognized[0], f"State recognition, {name}"),
        f"Precision over recall as the score's threshold falls, {_figure_of_the_paper(name)}. "
        "Closer to the top right is better.",
    )
    if any(one.recognizer.name == "smal" for one in found.recognized[0]):
        yield from _lengths(found, put)
    for criterion, judged in zip(world.criteria, found.recognized, strict=True):
        yield f"<p>By the criterion <b>{escape(criterion.meaning)}</b>:</p>{_table(judged)}"


def objective_section(found: Sequence[WorldResults], put: Put) -> Iterator[str]:
    """Write it as HTML, piece by piece; nothing where nobody measured it."""
    each = {one.world.title: one.objective for one in found if one.objective is not None}
    if not each:
        return
    yield "<h2>Objective value over iterations</h2>"
    yield put(
        "objective",
        figures.objective_figure(each),
        "Eq. 7 on one held-out query, after every iteration of Algorithm 2 as published and of this project's solver "
        "(one point for each tolerance, with its own duality gap), as in the paper's figures of the objective value. "
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


def _lengths(found: WorldResults, put: Put) -> Iterator[str]:
    name = found.world.title
    yield put(
        f"precision-recall-lengths-{name}",
        figures.precision_recall_by_length(found.recognized[0], f"Sequence lengths, {name}"),
        "The same for Eq. 9 with sequences of l frames (the paper's figure of precision-recall curves in its parameter "
        "analysis).",
    )
    yield put(
        f"area-lengths-{name}",
        figures.area_by_length(found.recognized[0], f"Area under the curve over l, {name}"),
        "Areas of the curves above; bars are 95 % intervals of a block bootstrap over the held-out frames.",
    )


def _criterion(world: WorldPlan) -> str:
    first = world.criteria[0]
    others = " and ".join(escape(one.meaning) for one in world.criteria[1:])
    views = "; ".join(f"<b>{name}</b>: {escape(DEGRADATIONS[name].meaning)}" for name in world.recognized)
    return (
        "<p><b>One criterion for all methods:</b> an answer is right if the demonstrated frame that the method takes "
        f"the robot to be at was taken {escape(first.meaning)} of the robot's true pose"
        f"{f' (beside it, stricter: {others})' if others else ''}. For Eq. 9 that is the frame of the "
        "best sequence at which W places the robot. The score is the weight of that sequence, for each frame; for the "
        "nearest frames the mean cosine, for SeqSLAM "
        "the negative mean difference along its best trajectory. Recall counts all frames that have a "
        f"right answer among the demonstrations. Queries are one in {JUDGED_TICKS} frames of "
        f"{world.queries} held-out drive{'' if world.queries == 1 else 's'}, the same for all methods: those from "
        f"frame {world.first_judged_tick} of a drive on, from which every method has a whole window. The last column "
        "is the area with the frames before, which cost a method of l frames its first l - 1 answers. Recall at 100 % "
        "precision is decided by the surest wrong answer alone, which a third of the bootstrap's draws lack: its "
        f"interval covers less than 95 %. Views: {views}.</p>"
    )


def _figure_of_the_paper(world: str) -> str:
    scene = "the indoor search" if world == "indoor" else "the urban search"
    return f"as in the paper's figure of precision-recall curves of {scene}"


def _table(found: Sequence[Recognized]) -> str:
    rows = [
        [
            one.recognizer.title,
            one.degradation,
            f"{one.curve.auc:.3f}",
            _interval(one.auc_95),
            f"{one.curve.recall_at_100_precision:.3f}",
            _interval(one.recall_95),
            f"{int(one.judgement.findable.sum())} of {one.judgement.score.size}",
            f"{one.auc_from_start:.3f}",
        ]
        for one in found
    ]
    head = ["method", "view", "area", "95 %", "recall at 100 % precision", "95 %", "frames with a right answer",
            "area from the start"]  # fmt: skip
    return html.table(head, rows, left=2)


def _interval(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.3f} to {ends[1]:.3f}"
