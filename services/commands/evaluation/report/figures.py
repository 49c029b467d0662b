"""The figures of the report, one function each."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.commands.evaluation.degradation import Degrader, degradation_named
from services.commands.evaluation.plan import DEFAULT_LENGTH, SCHEMES, Recogniser
from services.commands.evaluation.report.summary import (
    PEERS_OF_DEFAULT,
    Recognised,
    Success,
    controller_name,
    success_of,
)
from services.commands.evaluation.results import Finding
from services.jpeg import decode_jpeg
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map

_OURS, _SINGLE = "#0b5fa5", "#d1495b"
_PEERS: Final = {"nearest-1": "#8d99ae", "nearest-5": "#5c677d", "seqslam-10": "#e09f3e"}
_SCHEME: Final = {"paper": ("#d1495b", "s"), "overlapping": ("#e09f3e", "^"), "smal": (_OURS, "o")}
_PALE, _GRID = "#9aa5b1", "#e6e9ec"
#: Camera images beside an example route.
VIEWS: Final = 6


def precision_recall(found: Sequence[Recognised], title: str) -> Figure:
    """Draw SMAL at its default length against the single image and the peers, a panel for each degradation."""
    shown = [one for one in found if one.recogniser.name != "smal" or one.recogniser.length in (1, DEFAULT_LENGTH)]
    shown.sort(key=lambda one: (one.recogniser.name != "smal", one.recogniser.length == 1))

    def style(recogniser: Recogniser) -> dict[str, Any]:
        if recogniser.name != "smal":
            return {"color": _PEERS[recogniser.key], "lw": 1.6, "ls": "--", "zorder": 2}
        if recogniser.length == 1:
            return {"color": _SINGLE, "lw": 2.4, "zorder": 3}
        return {"color": _OURS, "lw": 2.8, "zorder": 4}

    return _curves(shown, style, title)


def precision_recall_by_length(found: Sequence[Recognised], title: str) -> Figure:
    """Draw SMAL at every length, darker the longer, a panel for each degradation."""
    shown = [one for one in found if one.recogniser.name == "smal"]
    lengths = sorted({one.recogniser.length for one in shown})
    colours = mpl.colormaps["viridis_r"](np.linspace(0.12, 0.95, len(lengths)))

    def style(recogniser: Recogniser) -> dict[str, Any]:
        return {"color": colours[lengths.index(recogniser.length)], "lw": 2.2}

    return _curves(shown, style, title)


def _curves(shown: Sequence[Recognised], style: Callable[[Recogniser], dict[str, Any]], title: str) -> Figure:
    """Draw curves in one panel for each degradation; a cross is where the novelty test of SMAL works."""
    degradations = list(dict.fromkeys(one.degradation for one in shown))
    figure = Figure(figsize=(5.2 * len(degradations), 5.4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(degradations)))
    least = min((float(one.curve.precision.min(initial=1.0)) for one in shown), default=0.0)
    floor = max(0.0, math.floor(10.0 * least - 2.0) / 10.0)
    for axes, degradation in zip(panels, degradations, strict=True):
        for one in (each for each in shown if each.degradation == degradation):
            look = style(one.recogniser)
            # Steps, as the area counts them.
            recall = np.concatenate([[0.0], one.curve.recall])
            precision = np.concatenate([one.curve.precision[:1], one.curve.precision])
            label = f"{one.name}  (area {one.curve.auc:.3f})"
            axes.step(recall[: precision.size], precision, where="pre", label=label, **look)
            if one.operating is not None:
                axes.plot(
                    *one.operating, "X", color=look["color"], ms=11, mec="white", mew=1.0, zorder=6, clip_on=False
                )
        axes.set(
            xlim=(0, 1.015),
            ylim=(floor, 1.0 + 0.03 * (1.0 - floor)),
            xlabel="recall",
            ylabel="precision",
            title=_seen(degradation),
        )
        axes.legend(loc="lower left", fontsize=9, framealpha=0.9)
        _plain(axes)
    figure.suptitle(title)
    return figure


def area_by_length(found: Sequence[Recognised], title: str) -> Figure:
    """Draw the area under the curve over l, with its interval, for every degradation; peers as lines across."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.add_subplot()
    lengths = sorted({one.recogniser.length for one in found if one.recogniser.name == "smal"})
    for degradation, colour in zip(dict.fromkeys(one.degradation for one in found), _cycle(), strict=False):
        each = {one.recogniser.length: one for one in found
                if one.recogniser.name == "smal" and one.degradation == degradation}  # fmt: skip
        area = np.array([each[length].curve.auc for length in lengths])
        low, high = np.array([each[length].auc_95 for length in lengths]).T
        around = np.maximum([area - low, high - area], 0.0)
        axes.errorbar(range(len(lengths)), area, around, color=colour, marker="o", lw=2, capsize=4,
                      label=f"SMAL, {_seen(degradation)}")  # fmt: skip
    axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
    axes.set(xlabel="sequence length l (frames)", ylabel="area under the curve", ylim=(None, 1.01), title=title)
    axes.legend(frameon=False, fontsize=9)
    _plain(axes)
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
        upper.plot(after, theirs, ".-", color=_SINGLE, label="Algorithm 2 as published")
        upper.plot(steps, values, "o-", color=_OURS, label="this project's solver")
        upper.axhline(bound, color=_PALE, ls="--", lw=1.0, label="certified lower bound")
        upper.set(
            ylabel="objective (Eq. 7)", title=f"{world}: {one['templates']:,} template frames, l = {one['length']}"
        )
        lower.semilogy(after, _gap(theirs, bound), ".-", color=_SINGLE)
        lower.semilogy(steps, np.maximum([point["duality_gap"] for point in ours], 1e-9), "o-", color=_OURS)
        lower.axhline(1e-4, color=_PALE, ls=":", lw=1.2)
        lower.axvline(20, color=_PALE, ls=":", lw=1.2, label="the paper: below 1e-4 within 20")
        lower.set(xlabel="iterations", ylabel="relative gap to the optimum", xlim=(0, None))
        for axes in (upper, lower):
            axes.legend(frameon=False, fontsize=9)
            _plain(axes)
    return figure


def _gap(objectives: NDArray[np.float64], bound: float) -> NDArray[np.float64]:
    gap: NDArray[np.float64] = np.maximum((objectives - bound) / objectives, 1e-9)
    return gap


def success_by_length(found: Sequence[Success], title: str) -> Figure:
    """Draw the success rate over l for every scheme, with Wilson's intervals, a panel for each degradation."""
    mine = [one for one in found if one.controller in SCHEMES]
    lengths = sorted({one.length for one in mine})
    degradations = list(dict.fromkeys(one.degradation for one in mine))
    figure = Figure(figsize=(5.6 * len(degradations), 4.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(degradations), sharey=True))
    for axes, degradation in zip(panels, degradations, strict=True):
        for number, scheme in enumerate(SCHEMES.values()):
            each = {one.length: one for one in mine
                    if (one.controller, one.degradation) == (scheme.name, degradation)}  # fmt: skip
            if each:
                colour, marker = _SCHEME[scheme.name]
                places = [lengths.index(length) + 0.09 * (number - 1) for length in each]
                _rates(axes, places, list(each.values()), {"color": colour, "marker": marker, "label": scheme.meaning})
        axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
        axes.set(xlabel="sequence length l (frames)", ylim=(-0.03, 1.05), title=_seen(degradation))
        _plain(axes)
    panels[0].set_ylabel("searches that found the victim")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)), frameon=False, fontsize=9)
    figure.suptitle(title)
    return figure


def _rates(axes: Axes, places: Sequence[float], each: Sequence[Success], look: dict[str, Any]) -> None:
    rate = np.array([one.rate for one in each])
    low, high = np.array([one.wilson_95 for one in each]).T
    axes.errorbar(places, rate, [rate - low, high - rate], lw=2, capsize=3, ms=6, elinewidth=1.2, **look)


def peers(found: Sequence[Success], title: str) -> Figure:
    """Draw success rates of SMAL at its defaults and of its peers, with Wilson's intervals."""
    ways = [("smal", DEFAULT_LENGTH), *PEERS_OF_DEFAULT]
    shown = [way for way in ways if any((one.controller, one.length) == way for one in found)]
    degradations = list(dict.fromkeys(one.degradation for one in found if (one.controller, one.length) == ways[0]))
    figure = Figure(figsize=(8.4, 1.3 + 0.62 * len(shown)), layout="constrained")
    axes = figure.add_subplot()
    height = 0.8 / len(degradations)
    for number, (degradation, colour) in enumerate(zip(degradations, _cycle(), strict=False)):
        for row, way in enumerate(shown):
            one = success_of(found, *way, degradation)
            if one is None:
                continue
            place = row + (number - (len(degradations) - 1) / 2) * height
            low, high = one.wilson_95
            axes.barh(place, one.rate, 0.9 * height, color=colour, alpha=0.9 if way == ways[0] else 0.55,
                      label=_seen(degradation) if row == 0 else None)  # fmt: skip
            axes.plot([low, high], [place, place], color="#333333", lw=1.2)
            axes.text(1.02, place, f"{one.found}/{one.runs}", va="center", fontsize=8, color="#333333")
    axes.set_yticks(range(len(shown)), [controller_name(*way) for way in shown])
    axes.invert_yaxis()
    axes.set(xlim=(0, 1.1), xlabel="searches that found the victim", title=title)
    axes.set_xticks(np.linspace(0, 1, 6))
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    _plain(axes)
    return figure


def example_route(
    world: str, route: Mapping[str, NDArray[Any]], seed: int, degradation: str | None, title: str
) -> Figure:
    """Draw the way of a search on the map, and what the camera saw along it.

    Parameters
    ----------
    world
        Its name.
    route
        ``poses``, ``ticks`` and ``picture_TICK`` (`search_experiment.route_file`).
    seed
        Of the search.
    degradation
        If given, the same views are shown as well as they would be under it.
    title
        One line.
    """
    poses, ticks = route["poses"], route["ticks"]
    chosen = [int(ticks[k]) for k in np.linspace(0, len(ticks) - 1, min(VIEWS, len(ticks))).round().astype(int)]
    rows = 1 if degradation is None else 2
    figure = Figure(figsize=(15.0, 6.2 + 1.9 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, len(chosen), height_ratios=[3.2, *([1.0] * rows)])
    _draw_way(figure.add_subplot(grid[0, :]), world, poses, chosen)
    views = {tick: decode_jpeg(route[f"picture_{tick}"].tobytes()) for tick in chosen}
    degraded = {} if degradation is None else _degraded(views, degradation, seed)
    for column, tick in enumerate(chosen):
        for row, pictures in enumerate((views, degraded)[:rows]):
            axes = figure.add_subplot(grid[1 + row, column])
            axes.imshow(pictures[tick])
            axes.set(xticks=[], yticks=[])
            if row == 0:
                axes.set_title(f"{column + 1}: after {tick / 10:.0f} s", fontsize=10)
            if column == 0:
                axes.set_ylabel("seen" if row == 0 else f"if {degradation}")
    figure.suptitle(title)
    return figure


def _draw_way(axes: Axes, world: str, poses: NDArray[np.float64], chosen: Sequence[int]) -> None:
    there = load_world(world)
    draw_map(there, axes)
    axes.plot(*poses[:, :2].T, color="#1a7f37", lw=2.4, zorder=4)
    for number, tick in enumerate(chosen, 1):
        axes.annotate(str(number), (poses[tick, 0], poses[tick, 1]), fontsize=9, ha="center", va="center", zorder=6,
                      bbox={"boxstyle": "circle,pad=0.2", "fc": "white", "ec": "#1a7f37", "lw": 1.2})  # fmt: skip
    low, high = (edge(poses[:, :2], axis=0) for edge in (np.min, np.max))
    victim = np.array([there.victim.x, there.victim.y])
    low, high = np.minimum(low, victim), np.maximum(high, victim)
    margin = 0.12 * float((high - low).max())
    x_min, y_min, x_max, y_max = there.place.bounds
    axes.set_xlim(max(x_min, low[0] - margin), min(x_max, high[0] + margin))
    axes.set_ylim(max(y_min, low[1] - margin), min(y_max, high[1] + margin))


def _degraded(views: Mapping[int, NDArray[np.uint8]], name: str, seed: int) -> dict[int, NDArray[np.uint8]]:
    """Degrade some views of an episode as its every frame would be; shake, which moves the camera, is not shown."""
    degrader, speck = Degrader(degradation_named(name), seed), np.zeros((1, 1, 3), dtype=np.uint8)
    seen = {tick: degrader.apply(tick, views.get(tick, speck)) for tick in range(max(views) + 1)}
    return {tick: seen[tick] for tick in views}


def _seen(degradation: str) -> str:
    # A title must not be wider than its axes.
    return "clear view" if degradation == "clean" else textwrap.fill(degradation_named(degradation).meaning, 46)


def _cycle() -> tuple[str, ...]:
    return (_OURS, _SINGLE, "#e09f3e", "#5c677d")


def _plain(axes: Axes) -> None:
    axes.grid(color=_GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
