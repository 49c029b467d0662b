"""Figures about searches: how often, and how soon, each way to drive finds the victim; and an example."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.commands.evaluation.degradation import Degrader, degradation_named
from services.commands.evaluation.plan import DEFAULT_LENGTH, PEERS
from services.commands.evaluation.report.figure_style import CYCLE, OURS, PEER_COLOURS, SINGLE, plain, seen
from services.commands.evaluation.report.summary import PEERS_OF_DEFAULT, Success, controller_name, success_of
from services.jpeg import decode_jpeg
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map

#: Camera images beside an example route.
VIEWS: Final = 6


def success_by_length(found: Sequence[Success], title: str) -> Figure:
    """Draw the success rate of the paper's scheme over l, with Wilson's intervals, a panel for each degradation.

    That of SMAL, which has no l, is a level line.
    """
    paper = [one for one in found if one.controller == "paper"]
    lengths = sorted({one.length for one in paper})
    figure, panels = _panels(paper)
    for degradation, axes in panels.items():
        each = [one for one in paper if one.degradation == degradation]
        rate = np.array([one.rate for one in each])
        low, high = np.array([one.wilson_95 for one in each]).T
        axes.errorbar([lengths.index(one.length) for one in each], rate, [rate - low, high - rate], color=SINGLE,
                      marker="s", lw=2, capsize=3, ms=6, elinewidth=1.2, label="the paper's scheme")  # fmt: skip
        ours = success_of(found, "smal", DEFAULT_LENGTH, degradation)
        if ours is not None:
            axes.axhline(ours.rate, color=OURS, ls="--", lw=2, label="SMAL, which has no sequences")
            axes.axhspan(*ours.wilson_95, color=OURS, alpha=0.08)
        axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
        axes.set(xlabel="sequence length l (frames)")
    return _titled(figure, title, "searches that found the victim")


def _panels(found: Sequence[Success]) -> tuple[Figure, dict[str, Axes]]:
    """Make a panel of shares for each degradation."""
    degradations = list(dict.fromkeys(one.degradation for one in found))
    figure = Figure(figsize=(5.6 * len(degradations), 4.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(degradations), sharey=True))
    for axes, degradation in zip(panels, degradations, strict=True):
        axes.set(ylim=(-0.03, 1.05), title=seen(degradation))
        plain(axes)
    return figure, dict(zip(degradations, panels, strict=True))


def _titled(figure: Figure, title: str, share: str) -> Figure:
    """Say what the panels show, and of whom below."""
    figure.axes[0].set_ylabel(share)
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    columns = min(3, max(1, len(labels)))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    figure.suptitle(title)
    return figure


def found_over_time(found: Sequence[Success], max_ticks: int, title: str) -> Figure:
    """Draw the share of searches that have found the victim by each frame, a panel for each degradation."""
    ways = {
        ("smal", DEFAULT_LENGTH): (OURS, "-"),
        ("paper", 1): (SINGLE, "-"),
        ("paper", DEFAULT_LENGTH): (SINGLE, ":"),
        **{(peer, DEFAULT_LENGTH): (PEER_COLOURS[peer], "--") for peer in PEERS},
    }
    figure, panels = _panels(found)
    for degradation, axes in panels.items():
        for way, (colour, line) in ways.items():
            one = success_of(found, *way, degradation)
            if one is not None:
                ticks, share = [0, *one.found_ticks, max_ticks], np.arange(one.found + 1) / one.runs
                axes.step(ticks, [*share, share[-1]], where="post", color=colour, ls=line, lw=2,
                          label=controller_name(*way))  # fmt: skip
        axes.set(xlim=(0, max_ticks), xlabel="frames since the start")
    return _titled(figure, title, "searches that have found the victim")


def peers(found: Sequence[Success], title: str) -> Figure:
    """Draw success rates of SMAL and of its peers, with Wilson's intervals."""
    ways = [("smal", DEFAULT_LENGTH), *PEERS_OF_DEFAULT]
    shown = [way for way in ways if any((one.controller, one.length) == way for one in found)]
    degradations = list(dict.fromkeys(one.degradation for one in found if (one.controller, one.length) == ways[0]))
    figure = Figure(figsize=(8.4, 1.3 + 0.62 * len(shown)), layout="constrained")
    axes = figure.add_subplot()
    height = 0.8 / len(degradations)
    for number, (degradation, colour) in enumerate(zip(degradations, CYCLE, strict=False)):
        for row, way in enumerate(shown):
            one = success_of(found, *way, degradation)
            if one is None:
                continue
            place = row + (number - (len(degradations) - 1) / 2) * height
            low, high = one.wilson_95
            axes.barh(place, one.rate, 0.9 * height, color=colour, alpha=0.9 if way == ways[0] else 0.55,
                      label=seen(degradation) if row == 0 else None)  # fmt: skip
            axes.plot([low, high], [place, place], color="#333333", lw=1.2)
            axes.text(1.02, place, f"{one.found}/{one.runs}", va="center", fontsize=8, color="#333333")
    axes.set_yticks(range(len(shown)), [controller_name(*way) for way in shown])
    axes.invert_yaxis()
    axes.set(xlim=(0, 1.1), xlabel="searches that found the victim", title=title)
    axes.set_xticks(np.linspace(0, 1, 6))
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    plain(axes)
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
