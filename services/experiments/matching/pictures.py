"""Matches of two traverses as a picture, and precision over recall beside it."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from smal.evaluation.ground_truth import IntervalTruth, judge
from smal.evaluation.precision_recall import PrecisionRecall
from smal.place_recognition import Matches

_BAND: Final = "#cfe8cf"
_WRONG: Final = "#c62828"
_CURVE: Final = "#1f5fa8"
_MUTED: Final = "#666666"
_UNJUDGED: Final = "#b8b8b8"


def draw_matches(
    matches: Matches, references: int, truth: IntervalTruth | None, curve: PrecisionRecall | None, title: str
) -> Figure:
    """Draw which reference every query frame matches.

    Parameters
    ----------
    matches
        Of all query frames.
    references
        Number of reference frames.
    truth
        If known: drawn below the matches; those that are wrong are marked.
    curve
        If known: drawn beside the matches.
    title
        One line.
    """
    figure = Figure(figsize=(7, 6) if curve is None else (12, 6), layout="constrained")
    figure.suptitle(title)
    columns = 1 if curve is None else 2
    axes = figure.add_subplot(1, columns, 1)
    if truth is not None:
        _draw_band(axes, truth)
    _draw_points(figure, axes, matches, truth)
    # A little more than all frames, so that no point is cut.
    across, up = matches.reference.size, references
    axes.set(xlim=(-1.0 - 0.02 * across, 1.02 * across), ylim=(-1.0 - 0.02 * up, 1.02 * up))
    axes.set(xlabel="query frame", ylabel="reference frame")
    axes.locator_params(integer=True)
    if curve is not None:
        _draw_curve(figure.add_subplot(1, columns, 2), curve)
    if truth is not None or not matches.matched.all():
        # Beside the matches, where it hides none.
        figure.legend(loc="outside lower center", ncols=4)
    return figure


def _draw_band(axes: Axes, truth: IntervalTruth) -> None:
    queries = np.flatnonzero(truth.findable)
    spans = truth.last[queries] - truth.first[queries] + 1
    axes.bar(queries, spans, width=1.0, bottom=truth.first[queries] - 0.5, color=_BAND, label="same place", zorder=1)


def _draw_points(figure: Figure, axes: Axes, matches: Matches, truth: IntervalTruth | None) -> None:
    matched = matches.matched
    queries = np.flatnonzero(matched)
    size = float(np.clip(4000.0 / max(matched.size, 1), 3.0, 22.0))
    points = axes.scatter(
        queries, matches.reference[matched], c=matches.score[matched], s=size, cmap="viridis", linewidths=0, zorder=3
    )
    if truth is not None:
        _draw_unjudged(axes, np.flatnonzero(matched & ~truth.judged), matches, size)
    if queries.size:
        figure.colorbar(points, ax=axes, label="score", shrink=0.8)
    else:
        axes.text(0.5, 0.5, "no match", transform=axes.transAxes, ha="center", color=_MUTED)
    _draw_unmatched(axes, np.flatnonzero(~matched))
    if truth is None:
        return
    wrong = _wrong(matches, truth)
    if wrong.size:
        label = f"wrong ({wrong.size} of {(matched & truth.judged).sum()})"
        axes.scatter(
            wrong,
            matches.reference[wrong],
            s=3.0 * size,
            label=label,
            zorder=2,
            facecolors="none",
            edgecolors=_WRONG,
            linewidths=0.9,
        )


def _draw_unjudged(axes: Axes, queries: NDArray[np.int64], matches: Matches, size: float) -> None:
    """Grey what the truth says nothing about: it is neither right nor wrong."""
    if queries.size:
        axes.scatter(queries, matches.reference[queries], s=1.3 * size, color=_UNJUDGED, linewidths=0, zorder=4,
                     label=f"not judged ({queries.size})")  # fmt: skip


def _draw_unmatched(axes: Axes, queries: NDArray[np.int64]) -> None:
    """Mark queries without a match at the lower edge: they count in the recall, and would go unnoticed."""
    if queries.size:
        at_edge = axes.get_xaxis_transform()
        axes.plot(queries, np.zeros(queries.size), "|", color=_MUTED, ms=9, transform=at_edge, clip_on=False, zorder=4,
                  label=f"no match ({queries.size})")  # fmt: skip


def _wrong(matches: Matches, truth: IntervalTruth) -> NDArray[np.int64]:
    judgement = judge(matches, truth)
    return np.flatnonzero(judgement.answered & judgement.judged & ~judgement.right)


def _draw_curve(axes: Axes, curve: PrecisionRecall) -> None:
    # Steps, as the area counts them; without any answer there is no curve.
    recall = np.concatenate([np.zeros(min(1, curve.recall.size)), curve.recall])
    axes.step(recall, np.concatenate([curve.precision[:1], curve.precision]), where="pre", color=_CURVE, lw=2)
    at_100 = curve.recall_at_100_precision
    if at_100 > 0.0:
        axes.plot([at_100], [1.0], "o", color=_CURVE, label=f"recall {at_100:.2f} at 100 % precision")
    axes.set(xlim=(0.0, 1.02), ylim=(0.0, 1.02), xlabel="recall", ylabel="precision", aspect="equal")
    axes.set_title(f"area under the curve {curve.auc:.3f}", fontsize="medium")
    axes.grid(alpha=0.3)
