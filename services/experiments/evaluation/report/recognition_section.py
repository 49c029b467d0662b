"""The part of the report about recognition: precision and recall of every method in a world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from services.experiments import html
from services.experiments.evaluation.degradation import degradation_named
from services.experiments.evaluation.plan import JUDGED_TICKS, WorldPlan
from services.experiments.evaluation.report import recognition_figures as figures
from services.experiments.evaluation.report.embedding import EmbeddedFigures
from services.experiments.evaluation.report.summary import Recognized, Results


def recognition_section(found: Results, put: EmbeddedFigures) -> Iterator[str]:
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


def _lengths(found: Results, put: EmbeddedFigures) -> Iterator[str]:
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
    views = "; ".join(f"<b>{name}</b>: {escape(degradation_named(name).meaning)}" for name in world.recognized)
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
            one.name,
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
