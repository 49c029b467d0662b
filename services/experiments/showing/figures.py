"""Figures of a map: taught ways, cost to go, and the belief along a drive."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.colours import BACK, COLOURS, LINE, MUTED, TEXT
from services.experiments.drawing import DASHES, WIDTH_IN, figure, legend, look_at, styled
from services.experiments.showing.ways import Believed, Ways
from services.simulator.world import World
from services.simulator.world.map_view import draw_map

MOST_NAMED: Final = len(COLOURS)  # With more lines than colours, the lines have no names.
_LONGEST_NAME: Final = 30


def _look(number: int) -> dict[str, Any]:
    return {"color": COLOURS[number % len(COLOURS)], "ls": DASHES[number % len(DASHES)]}


def _mark(axes: Axes, at: NDArray[np.float64], marker: str, size: float, **style: Any) -> None:  # noqa: ANN401
    usual: dict[str, Any] = {"mec": BACK, "ls": "", "zorder": 5}
    axes.plot(*at.T, marker, ms=size, **usual | style)


@styled
def draw_ways(
    ways: Ways, goals: Sequence[str], believed: Mapping[int, Believed], world: World | None = None
) -> Figure:
    """Draw the taught ways with their junctions, connected ways in one panel.

    If a world is given, the ways are in its axes and drawn on its map.
    """
    groups = [np.flatnonzero(ways.groups == group) for group in range(int(ways.groups.max()) + 1)]
    drawn = figure(0.7 * WIDTH_IN * len(groups) + 1.1)
    panels = list(drawn.subplots(len(groups), 1, squeeze=False)[:, 0])
    for axes, drives in zip(panels, groups, strict=True):
        axes.set_aspect("equal", adjustable="datalim" if world is None else "box")
        axes.set(xlabel=ways.unit, ylabel=ways.unit)
        axes.margins(0.12)
        for drive in drives.tolist():
            _draw_way(axes, ways, drive, goals)
        for drive in believed.keys() & set(drives.tolist()):
            _draw_wide_belief(axes, ways, drive, believed[drive])
        _draw_partings(axes, ways, drives.tolist())
        if world is not None:
            draw_map(world, axes, marks=False)
            look_at(axes, ways.key_poses[:, :2], world.place.bounds)
    legend(drawn, panels, 3)
    return drawn


def _draw_way(axes: Axes, ways: Ways, drive: int, goals: Sequence[str]) -> None:
    keys = np.flatnonzero(ways.of == drive)
    way = ways.key_poses[keys, :2]
    shared = ways.shared[keys]
    goal = ways.map.goals[drive]
    line = _look(goals.index(goal))
    if shared.any():
        on_shared = np.where(shared[:, None], way, np.nan)
        axes.plot(*on_shared.T, color=LINE, lw=7, label="shared", zorder=1)
    axes.plot(*way.T, lw=1.6, label=f"to {goal}", zorder=2, **line)
    _mark(axes, way[0], "o", 6, label="start", mfc=BACK, mec=TEXT)
    _mark(axes, way[-1], "*", 12, label=f"goal {goal}", color=line["color"])


def _draw_wide_belief(axes: Axes, ways: Ways, drive: int, believed: Believed) -> None:
    keys = np.flatnonzero(ways.of == drive)
    frames = ways.map.keyframes[keys] - int(np.searchsorted(ways.map.drives, drive))
    wide = keys[believed.here[frames] < 0.5]
    if wide.size:
        at = ways.key_poses[wide, :2]
        _mark(axes, at, "o", 9, label="wide belief", mfc="none", mec=COLOURS[1], zorder=3)


def _draw_partings(axes: Axes, ways: Ways, drives: Sequence[int]) -> None:
    for number, one in enumerate(ways.partings, 1):
        if one.drives[0] in drives:
            at = ways.key_poses[one.keyframe, :2]
            label, marker = ("fork", "D") if one.fork else ("ways meet", "s")
            _mark(axes, at, marker, 8, label=label, color=TEXT)
            offset: dict[str, Any] = {"xytext": (7, 5), "textcoords": "offset points"}
            axes.annotate(str(number), at.tolist(), **offset, weight="bold", zorder=9)


@styled
def draw_cost_to_go(ways: Ways, costs: NDArray[np.float64], names: Sequence[str]) -> Figure:
    """Draw the time to a goal along each drive with a route to it."""
    drawn = figure(2.6)
    axes = drawn.add_subplot()
    named = len(names) <= MOST_NAMED
    for drive, name in enumerate(names):
        on = ways.of == drive
        if np.isfinite(costs[on]).any():
            short = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
            label = short if named else None
            axes.plot(ways.way[on], costs[on], lw=1.6, label=label, **_look(drive))
    axes.set(xlabel=f"along the drive ({ways.unit})", ylabel="to go (s)")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    legend(drawn, [axes])
    return drawn


@styled
def draw_belief(ways: Ways, believed: Believed) -> Figure:
    """Draw the parts of the belief near the robot, elsewhere, and lost along a drive."""
    drawn = figure(3.4)
    shares, spread = drawn.subplots(2, 1, sharex=True)
    time_s = np.arange(len(believed.here)) * ways.map.tick_s
    parts = [believed.here, 1.0 - believed.here - believed.lost, believed.lost]
    labels = ["where it was", "elsewhere on the ways", "lost"]
    colours = [COLOURS[0], COLOURS[1], MUTED]
    shares.stackplot(time_s, parts, labels=labels, colors=colours, lw=0, alpha=0.7)
    shares.set(ylabel="belief", ylim=(0, 1), xlim=(0, max(float(time_s[-1]), ways.map.tick_s)))
    spread.plot(time_s, believed.spread, color=COLOURS[0], lw=1.6)
    spread.axhline(ways.map.correlation_length, color=MUTED, ls=":", label="views half as alike")
    spread.set(xlabel="time (s)", ylabel=f"spread ({ways.unit})")
    spread.set_ylim(bottom=0)
    legend(drawn, [shares, spread])
    return drawn
