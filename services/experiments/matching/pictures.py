"""Drawing of the matches of two traverses, with the precision-recall curve."""

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.colours import COLOURS, MUTED
from services.experiments.drawing import draw_curve, draw_reliability, styled
from services.experiments.matching.report import MatchQuality
from smal.evaluation.ground_truth import IntervalTruth
from smal.place_recognition import Matches

_BAND: Final = "#cfe8cf"
_WRONG: Final = "#c62828"


@styled
def draw_matches(
    matches: Matches,
    references: int,
    truth: IntervalTruth | None,
    quality: MatchQuality | None,
    title: str,
) -> Figure:
    """Draw the matched reference of every query frame over the ground truth, and the quality."""
    reliability = None if quality is None else quality.reliability
    panels = 1 + (quality is not None) + (reliability is not None)
    figure = Figure(figsize=(2 + 5 * panels, 6))
    figure.suptitle(title)
    axes, *more = figure.subplots(1, panels, squeeze=False)[0]
    axes.grid(visible=False)
    if truth is not None:
        spans = truth.last - truth.first + 1
        axes.bar(
            truth.query, spans, 1.0, truth.first - 0.5, color=_BAND, label="same place", zorder=1
        )
    _draw_points(figure, axes, matches, truth)
    # A little more than all frames, so that no point is cut.
    across = matches.reference.size
    up = references
    axes.set(xlim=(-1.0 - 0.02 * across, 1.02 * across), ylim=(-1.0 - 0.02 * up, 1.02 * up))
    axes.set(xlabel="query frame", ylabel="reference frame")
    axes.locator_params(integer=True)
    if quality is not None:
        curve = quality.curve
        panel = more[0]
        draw_curve(panel, curve, color=COLOURS[0], lw=2)
        if (at_100 := curve.recall_at_100_precision) > 0.0:
            panel.plot(
                [at_100],
                [1.0],
                "o",
                color=COLOURS[0],
                label=f"recall {at_100:.2f} at 100 % precision",
            )
        title = f"area under the curve {curve.auc:.3f}"
        panel.set(xlim=(0.0, 1.02), ylim=(0.0, 1.02), aspect="equal", title=title)
    if reliability is not None:
        draw_reliability(more[1], reliability)
    if truth is not None or not matches.matched.all():
        figure.legend(
            loc="outside lower center", ncols=4
        )  # Beside the matches, so that it hides no point.
    return figure


def _draw_points(figure: Figure, axes: Axes, matches: Matches, truth: IntervalTruth | None) -> None:
    matched = matches.matched
    size = float(np.clip(4000.0 / max(matched.size, 1), 3.0, 22.0))

    def mark(queries: NDArray[np.intp], label: str, **style: Any) -> None:  # noqa: ANN401 - matplotlib's
        if queries.size:
            axes.scatter(
                queries, matches.reference[queries], label=f"{label} ({queries.size})", **style
            )

    if matched.any():
        points = axes.scatter(np.flatnonzero(matched), matches.reference[matched], c=matches.score[matched], s=size,
                              cmap="viridis", linewidths=0, zorder=3)  # fmt: skip
        figure.colorbar(points, ax=axes, label="score", shrink=0.8)
    else:
        axes.text(0.5, 0.5, "no match", transform=axes.transAxes, ha="center", color=MUTED)
    if truth is not None:
        # Without ground truth, a match is neither correct nor wrong.
        mark(
            np.flatnonzero(matched & ~truth.judged),
            "not judged",
            s=1.3 * size,
            color="#b8b8b8",
            lw=0,
            zorder=4,
        )
        judgement = truth.judge(matches)
        wrong = np.flatnonzero(judgement.answered & judgement.judged & ~judgement.right)
        mark(
            wrong,
            "wrong",
            s=3.0 * size,
            facecolors="none",
            edgecolors=_WRONG,
            linewidths=0.9,
            zorder=2,
        )
    if (without := np.flatnonzero(~matched)).size:
        # At the lower edge: they count in the recall, and are easily missed.
        axes.plot(without, np.zeros(without.size), "|", color=MUTED, ms=9, transform=axes.get_xaxis_transform(),
                  clip_on=False, zorder=4, label=f"no match ({without.size})")  # fmt: skip
