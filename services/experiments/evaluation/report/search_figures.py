"""Figures about searches: how often, and how near the taught way, each driver finds the victim; and an example."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import Degrader, degradation_named
from services.experiments.evaluation.plan import CONTROLLERS, DEFAULT_LENGTH, Trial
from services.experiments.evaluation.report.figure_style import COLOURS, plain, seen
from services.experiments.evaluation.report.summary import Success, controller_name, success_of
from services.experiments.evaluation.search_experiment import WAY_TICKS
from services.kit.jpeg import decode_jpeg
from services.robot.clock import TICK_S
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map

#: Camera images beside an example route.
VIEWS: Final = 6


def found_by_drives(found: Sequence[Success], title: str) -> Figure:
    """Draw the share of searches that find the victim over the number of taught drives, for everybody."""
    plain_ones = [one for one in found if one.trial.condition == "as taught"]
    counts = sorted({one.trial.drives for one in plain_ones})
    names = [name for name in CONTROLLERS if any(one.trial.controller == name for one in plain_ones)]
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    width = 0.84 / len(names)
    for number, name in enumerate(names):
        for place, drives in enumerate(counts):
            one = success_of(plain_ones, Trial(name, drives, 1))
            if one is None:
                continue
            at = place + (number - (len(names) - 1) / 2) * width
            low, high = one.wilson_95
            label = controller_name(name, one.trial.length) if place == 0 else None
            axes.bar(at, one.rate, 0.9 * width, color=COLOURS[name], label=label)
            axes.plot([at, at], [low, high], color="#333333", lw=1.0)
            axes.text(at, 1.04, f"{one.found}/{one.runs}", ha="center", fontsize=6, color="#333333")
    axes.set_xticks(range(len(counts)), [str(count) for count in counts])
    axes.set(ylim=(0.0, 1.12), xlabel="taught drives", ylabel="searches that find the victim", title=title)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    plain(axes)
    return figure


def convergence(found: Sequence[Success], title: str) -> Figure:
    """Draw the distance from the taught way over time, of searches that begin beside it."""
    anywhere = [one for one in found if one.trial.condition == "from anywhere"]
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(anywhere), sharex=True, sharey=True))
    for axes, one in zip(panels, anywhere, strict=True):
        colour = COLOURS[one.trial.controller]
        ways = [np.array(each["aside_m"]) for each in one.findings.values()]
        for way in ways:
            axes.plot(np.arange(way.size) * WAY_TICKS * TICK_S, way, color=colour, lw=0.8, alpha=0.5)
        longest = max(way.size for way in ways)
        going = [[way[k] for way in ways if way.size > k] for k in range(longest)]
        shown = sum(2 * len(each) >= len(ways) for each in going)
        medians = [np.median(each) for each in going[:shown]]
        axes.plot(np.arange(shown) * WAY_TICKS * TICK_S, medians, color=colour, lw=2.6)
        axes.set(title=one.name, xlabel="seconds", xlim=(0.0, 1.2 * shown * WAY_TICKS * TICK_S))
        plain(axes)
    # Of all panels, which share the axis: after the last one has its lines.
    panels[0].set_ylim(bottom=0.0)
    panels[0].set_ylabel("from the taught way (m)")
    figure.suptitle(title)
    return figure


def success_by_length(found: Sequence[Success], title: str) -> Figure:
    """Draw the success rate of the paper's scheme over l, with Wilson's intervals, a panel for each degradation."""
    every = [one for one in found if one.trial.controller == "paper"]
    most = max(one.trial.drives for one in every if one.trial.length != DEFAULT_LENGTH)
    paper = [one for one in every if one.trial.drives == most]
    degradations = list(dict.fromkeys(one.trial.degradation for one in paper))
    ticks = sorted({one.trial.length for one in paper})
    figure = Figure(figsize=(5.6 * len(degradations), 4.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(degradations), sharey=True))
    for axes, degradation in zip(panels, degradations, strict=True):
        each = sorted((one for one in paper if one.trial.degradation == degradation), key=lambda one: one.trial.length)
        rate = np.array([one.rate for one in each])
        low, high = np.array([one.wilson_95 for one in each]).T
        axes.errorbar([ticks.index(one.trial.length) for one in each], rate, [rate - low, high - rate],
                      color=COLOURS["paper"], marker="s", lw=2, capsize=3, ms=6, elinewidth=1.2)  # fmt: skip
        axes.set_xticks(range(len(ticks)), [str(length) for length in ticks])
        axes.set(ylim=(-0.03, 1.05), title=seen(degradation), xlabel=f"sequence length l (frames), {most} drives")
        plain(axes)
    panels[0].set_ylabel("searches that found the victim")
    figure.suptitle(title)
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
