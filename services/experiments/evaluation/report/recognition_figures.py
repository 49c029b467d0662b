"""Figures about recognition: precision and recall, and the objective that it minimizes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.evaluation.plan import DEFAULT_LENGTH, Recognizer
from services.experiments.evaluation.report.figure_style import CYCLE, OURS, PALE, PEER_COLOURS, SINGLE, plain, seen
from services.experiments.evaluation.report.summary import Recognized
from services.experiments.evaluation.results import Finding


def precision_recall(found: Sequence[Recognized], title: str) -> Figure:
    """Draw Eq. 9 at its default length against the single image and the peers, a panel for each degradation."""
    shown = [one for one in found if one.recognizer.name != "smal" or one.recognizer.length in (1, DEFAULT_LENGTH)]
    shown.sort(key=lambda one: (one.recognizer.name != "smal", one.recognizer.length == 1))

    def style(recognizer: Recognizer) -> dict[str, Any]:
        if recognizer.name != "smal":
            return {"color": PEER_COLOURS[recognizer.key], "lw": 1.6, "ls": "--", "zorder": 2}
        if recognizer.length == 1:
            return {"color": SINGLE, "lw": 2.4, "zorder": 3}
        return {"color": OURS, "lw": 2.8, "zorder": 4}

    return _curves(shown, style, title)


def precision_recall_by_length(found: Sequence[Recognized], title: str) -> Figure:
    """Draw Eq. 9 at every length, darker the longer, a panel for each degradation."""
    shown = [one for one in found if one.recognizer.name == "smal"]
    lengths = sorted({one.recognizer.length for one in shown})
    colours = mpl.colormaps["viridis_r"](np.linspace(0.12, 0.95, len(lengths)))

    def style(recognizer: Recognizer) -> dict[str, Any]:
        return {"color": colours[lengths.index(recognizer.length)], "lw": 2.2}

    return _curves(shown, style, title)


def _curves(shown: Sequence[Recognized], style: Callable[[Recognizer], dict[str, Any]], title: str) -> Figure:
    """Draw curves in one panel for each degradation."""
    degradations = list(dict.fromkeys(one.degradation for one in shown))
    figure = Figure(figsize=(5.2 * len(degradations), 5.4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(degradations)))
    least = min((float(one.curve.precision.min(initial=1.0)) for one in shown), default=0.0)
    floor = max(0.0, math.floor(10.0 * least - 2.0) / 10.0)
    for axes, degradation in zip(panels, degradations, strict=True):
        for one in (each for each in shown if each.degradation == degradation):
            # Steps, as the area counts them.
            recall = np.concatenate([[0.0], one.curve.recall])
            precision = np.concatenate([one.curve.precision[:1], one.curve.precision])
            label = f"{one.name}  (area {one.curve.auc:.3f})"
            axes.step(recall[: precision.size], precision, where="pre", label=label, **style(one.recognizer))
        axes.set(
            xlim=(0, 1.015),
            ylim=(floor, 1.0 + 0.03 * (1.0 - floor)),
            xlabel="recall",
            ylabel="precision",
            title=seen(degradation),
        )
        axes.legend(loc="lower left", fontsize=9, framealpha=0.9)
        plain(axes)
    figure.suptitle(title)
    return figure


def area_by_length(found: Sequence[Recognized], title: str) -> Figure:
    """Draw the area under the curve over l, with its interval, for every degradation."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.add_subplot()
    lengths = sorted({one.recognizer.length for one in found if one.recognizer.name == "smal"})
    for degradation, colour in zip(dict.fromkeys(one.degradation for one in found), CYCLE, strict=False):
        each = {one.recognizer.length: one for one in found
                if one.recognizer.name == "smal" and one.degradation == degradation}  # fmt: skip
        if not each:
            continue
        area = np.array([one.curve.auc for one in each.values()])
        low, high = np.array([one.auc_95 for one in each.values()]).T
        around = np.maximum([area - low, high - area], 0.0)
        axes.errorbar([lengths.index(length) for length in each], area, around, color=colour, marker="o", lw=2,
                      capsize=4, label=f"Eq. 9, {seen(degradation)}")  # fmt: skip
    axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
    axes.set(xlabel="sequence length l (frames)", ylabel="area under the curve", ylim=(None, 1.01), title=title)
    axes.legend(frameon=False, fontsize=9)
    plain(axes)
    return figure


def objective(found: Mapping[str, Finding]) -> Figure:
    """Draw Eq. 7 over the iterations of Algorithm 2 and of this project's solver; the gap to the optimum below."""
    figure = Figure(figsize=(5.4 * len(found), 7.0), layout="constrained")
    panels = figure.subplots(2, len(found), squeeze=False, sharex="col")
    for column, (world, one) in enumerate(found.items()):
        upper, lower = panels[:, column]
        theirs = np.array(one["algorithm2"])
        ours = [point for point in one["ours"] if point["iterations"] > 0]
        steps, values = ([point[name] for point in ours] for name in ("iterations", "objective"))
        after, bound = np.arange(1, theirs.size + 1), one["lower_bound"]
        upper.plot(after, theirs, ".-", color=SINGLE, label="Algorithm 2 as published")
        upper.plot(steps, values, "o-", color=OURS, label="this project's solver")
        upper.axhline(bound, color=PALE, ls="--", lw=1.0, label="certified lower bound")
        lower.axvspan(9, 12, color=PALE, alpha=0.18, lw=0.0, label="the paper: 9 and 12 iterations")
        upper.set(
            ylabel="objective (Eq. 7)", title=f"{world}: {one['templates']:,} template frames, l = {one['length']}"
        )
        lower.semilogy(after, _gap(theirs, bound), ".-", color=SINGLE)
        lower.semilogy(steps, np.maximum([point["duality_gap"] for point in ours], 1e-9), "o-", color=OURS)
        lower.axhline(1e-4, color=PALE, ls=":", lw=1.2)
        lower.axvline(20, color=PALE, ls=":", lw=1.2, label="the paper: below 1e-4 within 20")
        lower.set(xlabel="iterations", ylabel="relative gap to the optimum", xlim=(0, None))
        for axes in (upper, lower):
            axes.legend(frameon=False, fontsize=9)
            plain(axes)
    return figure


def _gap(objectives: NDArray[np.float64], bound: float) -> NDArray[np.float64]:
    gap: NDArray[np.float64] = np.maximum((objectives - bound) / objectives, 1e-9)
    return gap
