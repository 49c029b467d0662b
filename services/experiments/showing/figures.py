"""Figures of what was learned, one function each."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.drawing import BACK, COLOURS, DASHES, LINE, MUTED, TEXT, WIDTH_IN, legend, styled
from services.experiments.drawing import figure as new_figure
from services.experiments.showing.ways import Believed, Ways

MOST_NAMED: Final = len(COLOURS)  # As many lines as there are colours are told apart, and named.
_FORK, _MEETING = "D", "s"


def _look(number: int) -> dict[str, Any]:
    return {"color": COLOURS[number % len(COLOURS)], "ls": DASHES[number % len(DASHES)]}


def _mark(axes: Axes, at: NDArray[np.float64], marker: str, size: float, label: str, **style: Any) -> None:  # noqa: ANN401
    usual: dict[str, Any] = {"mec": BACK, "ls": "", "zorder": 5}
    axes.plot(*at.T, marker, ms=size, label=label, **usual | style)


@styled
def draw_ways(ways: Ways, goals: Sequence[str], believed: Mapping[int, Believed]) -> Figure:
    """Draw the taught ways, those that are joined in one picture, and where they part and meet."""
    places = ways.key_poses[:, :2]
    groups = [np.flatnonzero(ways.groups == group) for group in range(int(ways.groups.max()) + 1)]
    figure = new_figure(0.7 * WIDTH_IN * len(groups) + 1.1)
    panels = list(figure.subplots(len(groups), 1, squeeze=False)[:, 0])
    for axes, drives in zip(panels, groups, strict=True):
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=ways.unit, ylabel=ways.unit)
        axes.margins(0.12)
        for drive in drives.tolist():
            keys = np.flatnonzero(ways.of == drive)
            _draw_way(axes, ways, places[keys], ways.shared[keys], drive, goals)
            if drive in believed:
                frames = ways.map.keyframes[keys] - int(np.searchsorted(ways.map.drives, drive))
                wide = keys[believed[drive].here[frames] < 0.5]
                if wide.size:
                    _mark(axes, places[wide], "o", 9, "wide belief", mfc="none", mec=COLOURS[1], zorder=3)
        for number, one in enumerate(ways.partings, 1):
            if one.drives[0] in drives:
                label, marker = ("fork", _FORK) if one.fork else ("ways meet", _MEETING)
                _mark(axes, places[one.keyframe], marker, 8, label, color=TEXT)
                x, y = places[one.keyframe].tolist()
                axes.annotate(str(number), (x, y), (7, 5), textcoords="offset points", weight="bold", zorder=9)
    legend(figure, panels, 3)
    return figure


def _draw_way(
    axes: Axes, ways: Ways, way: NDArray[np.float64], shared: NDArray[np.bool_], drive: int, goals: Sequence[str]
) -> None:
    goal = ways.map.goals[drive]
    line = _look(goals.index(goal))
    if shared.any():
        axes.plot(*np.where(shared[:, None], way, np.nan).T, color=LINE, lw=7, label="shared", zorder=1)
    axes.plot(*way.T, lw=1.6, label=f"to {goal}", zorder=2, **line)
    _mark(axes, way[0], "o", 6, "start", mfc=BACK, mec=TEXT)
    _mark(axes, way[-1], "*", 12, f"goal {goal}", color=line["color"])


@styled
def draw_cost_to_go(ways: Ways, costs: NDArray[np.float64], names: Sequence[str]) -> Figure:
    """Draw the time to a goal along each drive from which a way leads there."""
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    for drive, name in enumerate(names):
        on = ways.of == drive
        if np.isfinite(costs[on]).any():
            label = (name if len(name) <= 30 else f"{name[:29]}…") if len(names) <= MOST_NAMED else None
            axes.plot(ways.way[on], costs[on], lw=1.6, label=label, **_look(drive))
    axes.set(xlabel=f"along the drive ({ways.unit})", ylabel="to go (s)")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    legend(figure, [axes])
    return figure


@styled
def draw_belief(ways: Ways, believed: Believed) -> Figure:
    """Draw where the belief was along a drive: here, elsewhere, or nowhere."""
    figure = new_figure(3.4)
    shares, spread = figure.subplots(2, 1, sharex=True)
    time_s = np.arange(len(believed.here)) * ways.map.tick_s
    parts = [believed.here, 1.0 - believed.here - believed.lost, believed.lost]
    labels, colours = ["where it was", "elsewhere on the ways", "lost"], [COLOURS[0], COLOURS[1], MUTED]
    shares.stackplot(time_s, parts, labels=labels, colors=colours, lw=0, alpha=0.7)
    shares.set(ylabel="belief", ylim=(0, 1), xlim=(0, max(float(time_s[-1]), ways.map.tick_s)))
    spread.plot(time_s, believed.spread, color=COLOURS[0], lw=1.6)
    spread.axhline(ways.map.correlation_length, color=MUTED, ls=":", label="views half as alike")
    spread.set(xlabel="time (s)", ylabel=f"spread ({ways.unit})")
    spread.set_ylim(bottom=0)
    legend(figure, [shares, spread])
    return figure
