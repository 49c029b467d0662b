"""Figures of an evaluation."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from schemas.base import TICK_S
from services.experiments.colours import COLOURS, TEXT
from services.experiments.drawing import draw_curve, look_at, styled
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.drivers import DEFAULT_LENGTH
from services.experiments.evaluation.plan import RecognizerName
from services.experiments.evaluation.report.summary import Recognized, Success
from services.kit.jpeg import decode_jpeg
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map
from smal.arrays import evenly

VIEWS: Final = 6  # Camera images beside an example route.
_PEERS: Final = {
    "smal": COLOURS[0], f"paper-{DEFAULT_LENGTH}": COLOURS[1], "teach-and-repeat": "#e09f3e",
    "teach-and-repeat-told": "#b5651d", "place-filter": "#6a994e", "nearest-1": "#8d99ae", "nearest-5": "#5c677d",
    "smal-waits": "#7aa6c2", "smal-unguarded": "#999999",
}  # fmt: skip


@styled
def precision_recall(found: Sequence[Recognized], title: str) -> Figure:
    """Draw the curves of Eq. 9 (darker if longer) and of baselines (dashed), by degradation."""
    views = _views(one.degradation for one in found)
    lengths = sorted({one.recognizer.length for one in found})
    drawn, panels = _panels(len(views), 5.2, 5.4, title)
    least = min(float(one.curve.precision.min(initial=1.0)) for one in found)
    floor = max(0.0, math.floor(10.0 * least - 2.0) / 10.0)
    for axes, (degradation, view) in zip(panels, views.items(), strict=True):
        for one in found:
            if one.degradation == degradation:
                label = f"{one.recognizer.title}  (area {one.curve.auc:.3f})"
                draw_curve(axes, one.curve, label=label, lw=2.2, **_style(one.recognizer, lengths))
        axes.set(xlim=(0, 1.015), ylim=(floor, 1.0 + 0.03 * (1.0 - floor)), title=view)
        axes.legend(loc="lower left")
    return drawn


def _style(recognizer: RecognizerName, lengths: Sequence[int]) -> dict[str, Any]:
    if not recognizer.eq9:
        return {"color": _PEERS[f"nearest-{recognizer.length}"], "ls": "--"}
    share = lengths.index(recognizer.length) / len(lengths)
    return {"color": mpl.colormaps["viridis_r"](0.12 + 0.83 * share)}


@styled
def found_by_drives(found: Sequence[Success], title: str) -> Figure:
    """Draw the share of successful searches over the number of taught drives, for each driver."""
    usual = [one for one in found if one.trial.condition == "as taught"]
    counts = sorted({one.trial.drives for one in usual})
    usual = [one for one in usual if one.trial.length in (None, DEFAULT_LENGTH)]
    names = list(dict.fromkeys(one.trial.driver for one in usual))
    drawn, (axes,) = _panels(1, 9.0, 4.6, title)
    width = 0.84 / len(names)
    for one in usual:
        name = one.trial.driver
        group = counts.index(one.trial.drives)
        at = group + (names.index(name) - (len(names) - 1) / 2) * width
        label = None if group else one.trial.title
        axes.bar(at, one.rate, 0.9 * width, color=_PEERS.get(name, TEXT), label=label)
        axes.plot([at, at], one.wilson_95, color=TEXT, lw=1.0)
        axes.text(at, 1.04, f"{one.succeeded}/{one.runs}", ha="center", fontsize=6)
    axes.set_xticks(range(len(counts)), [str(count) for count in counts])
    axes.set(ylim=(0.0, 1.12), xlabel="taught drives", ylabel="successful searches")
    drawn.legend(loc="outside lower center", ncols=3)
    return drawn


@styled
def success_by_length(found: Sequence[Success], title: str) -> Figure:
    """Draw the success rate of the paper's scheme over l with Wilson intervals, by degradation."""
    every = [one for one in found if one.trial.length is not None]
    most = max(one.trial.drives for one in every if one.trial.length != DEFAULT_LENGTH)
    paper = [one for one in every if one.trial.drives == most]
    lengths = sorted({one.trial.length for one in paper if one.trial.length is not None})
    views = _views(one.trial.degradation for one in paper)
    drawn, panels = _panels(len(views), 5.6, 4.2, title, sharey=True)
    for axes, (degradation, view) in zip(panels, views.items(), strict=True):
        _draw_rates(axes, [one for one in paper if one.trial.degradation == degradation], lengths)
        axes.set(title=view, xlabel=f"sequence length l (frames), {most} drives")
    panels[0].set_ylabel("successful searches")
    return drawn


def _draw_rates(axes: Axes, found: Sequence[Success], lengths: Sequence[int]) -> None:
    found = sorted(found, key=lambda one: one.trial.length or 0)
    rates = np.array([one.rate for one in found])
    low, high = np.array([one.wilson_95 for one in found]).T
    at = [lengths.index(one.trial.length or 0) for one in found]
    around = np.maximum([rates - low, high - rates], 0.0)
    look: dict[str, Any] = {"color": COLOURS[1], "marker": "s", "lw": 2}
    axes.errorbar(at, rates, around, capsize=4, elinewidth=1.2, **look)
    axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
    axes.set_ylim(-0.03, 1.05)


@styled
def example_route(world: str, route: Mapping[str, NDArray[Any]], title: str) -> Figure:
    """Draw the route of a search, its ``poses``, on the map, with camera images by tick."""
    poses = route["poses"]
    ticks = np.sort([int(name) for name in route if name.isdigit()])
    chosen = ticks[evenly(len(ticks), VIEWS)].tolist()
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
        axes.set(xticks=[], yticks=[], title=f"{column + 1}: after {tick * TICK_S:.0f} s")
        axes.grid(visible=False)
    return drawn


def _panels(
    count: int, width: float, height: float, title: str, *, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side; width and height in inches per panel."""
    drawn = Figure(figsize=(width * count, height))
    drawn.suptitle(title)
    return drawn, list(drawn.subplots(1, count, squeeze=False, sharey=sharey)[0])


def _views(degradations: Iterable[str]) -> dict[str, str]:
    """Return each degradation once, with its description wrapped to the width of a panel."""
    return {
        name: "clear view" if name == "clean" else textwrap.fill(DEGRADATIONS[name].meaning, 46)
        for name in dict.fromkeys(degradations)
    }
