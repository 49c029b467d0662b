"""The ways of a robot, drawn on the map of its world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.cli.episodes.client import EpisodeRecord
from services.simulator.world import known_worlds, load_world
from services.simulator.world.map_view import draw_map

#: Half the side of what is shown, in sizes of what happened.
_AROUND: Final = 1.5
OUTCOME_COLOURS: Final = {
    "found": "#1a7f37", "collision": "#c62828", "timeout": "#b26a00", "false_goal": "#7b1fa2", "aborted": "#666666"
}  # fmt: skip


def draw_routes(world: str | None, records: Sequence[EpisodeRecord]) -> Figure:
    """Return the map of a world with the way of every episode, coloured by how it ended.

    Parameters
    ----------
    world
        Its name or path; without one that of the episodes, if that is one that is known here. The ways of a robot that
        is nowhere that has a map are drawn by themselves.
    records
        At least one.
    """
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot()
    # What a robot tells may be the name of a world of ours, but never a path to be read.
    name = world or (records[0].world if records[0].world in known_worlds() else None)
    there = None if name is None else load_world(name)
    seen: list[NDArray[np.float64]] = []
    for record in records:
        if record.poses:
            xy = np.array([record.poses[tick] for tick in sorted(record.poses)])
            colour = OUTCOME_COLOURS[record.outcome]
            axes.plot(*xy.T, color=colour, lw=1.6, alpha=0.75, label=record.outcome, zorder=3)
            axes.plot(*xy[-1], "x", color=colour, ms=6, zorder=3)
            seen.append(xy)
    if there is None:
        axes.set(aspect="equal", xlabel="m", ylabel="m")
    else:
        draw_map(there, axes)
        seen.append(np.array([(there.start.x, there.start.y), (there.victim.x, there.victim.y)]))
        _look_at(axes, np.concatenate(seen), there.place.bounds)
    # Beside the map, where it hides nothing.
    handles, labels = axes.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    figure.legend(by_label.values(), by_label.keys(), loc="outside lower center", ncols=6)
    return figure


def _look_at(axes: Axes, points: NDArray[np.float64], bounds: tuple[float, float, float, float]) -> None:
    """Show the part of a map where something happened, and about as much around it; a small map whole."""
    low, high = points.min(axis=0), points.max(axis=0)
    half_m = _AROUND * float((high - low).max())
    middle = (low + high) / 2
    x_min, y_min, x_max, y_max = bounds
    axes.set_xlim(max(x_min, middle[0] - half_m), min(x_max, middle[0] + half_m))
    axes.set_ylim(max(y_min, middle[1] - half_m), min(y_max, middle[1] + half_m))
