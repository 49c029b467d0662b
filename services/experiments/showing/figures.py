"""Figures of what was learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.drawing import BACK, COLOURS, DASHES, LINE, MUTED, TEXT, WIDTH_IN, legend, styled
from services.experiments.drawing import figure as new_figure
from services.experiments.showing.belief import Believed
from services.experiments.showing.states import StateGraph
from services.experiments.showing.ways import Parting, Ways, schematic
from smal.paper.model import Model as PaperModel
from smal.paper.sequences import last_frames

#: As many lines as there are colours are told apart, and named.
MOST_NAMED: Final = len(COLOURS)
_FORK, _MEETING = "D", "s"


def look(number: int) -> dict[str, Any]:
    """Return colour and dashes of a line."""
    return {"color": COLOURS[number % len(COLOURS)], "ls": DASHES[number % len(DASHES)]}


@styled
def draw_ways(ways: Ways, goals: Sequence[str], believed: Mapping[int, Believed]) -> Figure:
    """Draw the taught ways, those that are joined in one picture, and where they part and meet."""
    places = _places(ways)
    groups = [np.flatnonzero(ways.groups == group) for group in range(int(ways.groups.max()) + 1)]
    figure, panels = _panels(ways, places, groups)
    for axes, drives in zip(panels, groups, strict=True):
        for drive in drives.tolist():
            _draw_way(axes, ways, places, drive, goals)
            if drive in believed:
                _draw_wide(axes, ways, places, drive, believed[drive])
        here = [one for one in ways.partings if one.drives[0] in drives]
        _draw_partings(axes, here, ways.partings, places)
    legend(figure, panels, 3)
    return figure


@styled
def draw_states(model: PaperModel, graph: StateGraph) -> Figure:
    """Draw the states in the order of the drives, and what follows what."""
    at = schematic([[(state, 1.0) for state in stream.tolist()] for stream in model.state_streams])
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    axes.set(xlabel="states after the start", yticks=[])
    axes.margins(0.05, 0.25)
    goals = set(model.transitions.goals.tolist())
    _draw_graph(axes, {int(str(state)): place for state, place in at.items()}, graph, goals)
    legend(figure, [axes], 3)
    return figure


@styled
def draw_cost_to_go(ways: Ways, costs: NDArray[np.float64], names: Sequence[str]) -> Figure:
    """Draw the time to a goal along each drive from which a way leads there."""
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    for drive, name in enumerate(names):
        on = ways.of == drive
        if np.isfinite(costs[on]).any():
            way = ways.way[ways.map.keyframes[on]]
            axes.plot(way, costs[on], lw=1.6, label=_named(name, names), **look(drive))
    axes.set(xlabel=f"along the drive ({unit(ways)})", ylabel="to go (s)")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    legend(figure, [axes])
    return figure


@styled
def draw_belief(ways: Ways, drive: int, believed: Believed) -> Figure:
    """Draw where the belief was along a drive: here, elsewhere, or nowhere."""
    figure = new_figure(3.4)
    shares, spread = figure.subplots(2, 1, sharex=True)
    time_s = np.arange(len(believed.here)) * ways.map.tick_s
    elsewhere = 1.0 - believed.here - believed.lost
    shares.stackplot(
        time_s,
        [believed.here, elsewhere, believed.lost],
        labels=["where it was", "elsewhere on the ways", "lost"],
        colors=[COLOURS[0], COLOURS[1], MUTED],
        lw=0,
        alpha=0.7,
    )
    shares.set(ylabel="belief", ylim=(0, 1), xlim=(0, max(float(time_s[-1]), ways.map.tick_s)))
    spread.plot(time_s, believed.spread, color=COLOURS[0], lw=1.6)
    spread.axhline(ways.map.correlation_length, color=MUTED, ls=":", label="views half as alike")
    spread.set(xlabel="time (s)", ylabel=f"spread ({unit(ways)})")
    spread.set_ylim(bottom=0)
    legend(figure, [shares, spread])
    return figure


@styled
def draw_reward(model: PaperModel, names: Sequence[str]) -> Figure:
    """Draw the reward of the state of each frame, and below it what is to be had from there on."""
    figure = new_figure(3.6)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, values, said in zip(panels, (model.reward, model.value), ("reward R", "value V"), strict=True):
        for drive, (stream, atoms) in enumerate(zip(model.state_streams, model.atoms, strict=True)):
            frames = last_frames(len(atoms), model.sequence_length)
            label = _named(names[drive], names)
            axes.step(frames, values[stream], where="pre", lw=1.6, label=label, **look(drive))
        axes.set_ylabel(said)
    panels[1].set_xlabel("frame of the drive")
    legend(figure, panels)
    return figure


def unit(ways: Ways) -> str:
    """Return the unit of lengths of a map."""
    return "m" if ways.map.odometry else "atoms ahead"


def _named(name: str, names: Sequence[str]) -> str | None:
    return (name if len(name) <= 30 else f"{name[:29]}…") if len(names) <= MOST_NAMED else None


def _places(ways: Ways) -> NDArray[np.float64]:
    """Return where each keyframe is drawn: by odometry, or, without it, in a row for each drive."""
    if ways.map.odometry:
        return ways.key_poses[:, :2]
    partner = {one: other for one, other in ways.map.stitched.tolist() if ways.of[other] < ways.of[one]}
    along = ways.way[ways.map.keyframes]
    streams = []
    for drive in range(len(ways.map.goals)):
        keys = np.flatnonzero(ways.of == drive)
        steps = np.diff(along[keys], prepend=0.0)
        streams.append([(_first_of(key, partner), float(step)) for key, step in zip(keys.tolist(), steps, strict=True)])
    places = schematic(streams)
    return np.array([places[_first_of(key, partner)] for key in range(len(ways.of))])


def _first_of(keyframe: int, partner: Mapping[int, int]) -> int:
    while keyframe in partner:
        keyframe = partner[keyframe]
    return keyframe


def _panels(
    ways: Ways, places: NDArray[np.float64], groups: Sequence[NDArray[np.intp]]
) -> tuple[Figure, Sequence[Axes]]:
    """Make axes for each group of drives, to scale where the places are."""
    sizes = [np.ptp(places[np.isin(ways.of, drives)], axis=0) for drives in groups]
    # Upright where the way is, within what is no wider than high or higher than one and a half times.
    shape = max((float(high / max(wide, 1e-9)) for wide, high in sizes), default=1.0)
    columns = min(2, len(groups))
    rows = -(-len(groups) // columns)
    each = WIDTH_IN / columns * float(np.clip(shape, 0.4, 1.2)) if ways.map.odometry else 1.6
    figure = new_figure(rows * each + 1.1)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[len(groups) :]:
        axes.remove()
    for axes in panels[: len(groups)]:
        if ways.map.odometry:
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(xlabel="m", ylabel="m")
        else:
            axes.set(xlabel=f"way ({unit(ways)}), not to scale", yticks=[])
        axes.margins(0.12, 0.12 if ways.map.odometry else 0.4)
    return figure, panels[: len(groups)]


def _draw_way(axes: Axes, ways: Ways, places: NDArray[np.float64], drive: int, goals: Sequence[str]) -> None:
    keys = np.flatnonzero(ways.of == drive)
    goal = ways.map.goals[drive]
    line = look(goals.index(goal))
    shared = np.where(ways.shared[keys, None], places[keys], np.nan)
    if ways.shared[keys].any():
        axes.plot(*shared.T, color=LINE, lw=7, solid_capstyle="round", label="shared", zorder=1)
    axes.plot(*places[keys].T, lw=1.6, label=f"to {goal}", zorder=2, **line)
    axes.plot(*places[keys[0]], "o", ms=6, mfc=BACK, mec=TEXT, ls="", label="start", zorder=4)
    axes.plot(*places[keys[-1]], "*", ms=12, color=line["color"], mec=BACK, ls="", label=f"goal {goal}", zorder=4)


def _draw_wide(axes: Axes, ways: Ways, places: NDArray[np.float64], drive: int, believed: Believed) -> None:
    keys = np.flatnonzero(ways.of == drive)
    frames = ways.map.keyframes[keys] - int(np.searchsorted(ways.map.drives, drive))
    wide = keys[believed.here[frames] < 0.5]
    if wide.size:
        axes.plot(*places[wide].T, "o", ms=9, mfc="none", mec=COLOURS[1], ls="", label="wide belief", zorder=3)


def _draw_partings(axes: Axes, here: Sequence[Parting], every: Sequence[Parting], places: NDArray[np.float64]) -> None:
    for one in here:
        at = places[one.keyframe]
        label, marker = ("fork", _FORK) if one.fork else ("ways meet", _MEETING)
        axes.plot(*at, marker, ms=8, color=TEXT, mec=BACK, ls="", label=label, zorder=5)
        axes.annotate(str(every.index(one) + 1), at, xytext=(7, 5), textcoords="offset points", weight="bold", zorder=6)


def _draw_graph(axes: Axes, places: Mapping[int, Sequence[float]], graph: StateGraph, goals: set[int]) -> None:
    lines = [
        (places[state], places[then])
        for state, following in graph.following.items()
        for then in following
        if state in places and then in places
    ]
    if lines:
        broken = np.array([(*pair, (np.nan, np.nan)) for pair in lines]).reshape(-1, 2)
        axes.plot(*broken.T, color=MUTED, lw=1.0, zorder=1)
    shared, forks = set(graph.shared), set(graph.forks)
    kinds: list[tuple[str, str, float, str, list[int]]] = [
        ("state", "o", 4, COLOURS[0], [state for state in places if state not in shared]),
        ("shared by drives", "o", 7, COLOURS[3], [state for state in places if state in shared]),
        ("fork", _FORK, 8, TEXT, [state for state in places if state in forks]),
        ("goal", "*", 12, COLOURS[2], [state for state in places if state in goals]),
    ]
    for height, (label, marker, size, colour, states) in enumerate(kinds, 2):
        if states:
            xy = np.array([places[state] for state in states])
            axes.plot(*xy.T, marker, ms=size, color=colour, mec=BACK, mew=0.5, ls="", label=label, zorder=height)
    for state in forks & places.keys():
        axes.annotate(
            str(state),
            (places[state][0], places[state][1]),
            xytext=(6, 5),
            textcoords="offset points",
            weight="bold",
            zorder=9,
        )
