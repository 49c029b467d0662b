"""The ways of a robot, drawn on the map of its world."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from services.commands.episodes import EpisodeRecord
from services.simulator.world import load_world
from services.simulator.world.map_view import draw_map

OUTCOME_COLOURS: Final = {"found": "#1a7f37", "collision": "#c62828", "timeout": "#b26a00", "aborted": "#666666"}


def draw_routes(world: str, records: Iterable[EpisodeRecord]) -> Figure:
    """Return the map of a world with the way of every episode, coloured by how it ended."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot()
    draw_map(load_world(world), axes)
    labelled: set[str] = set()
    for record in records:
        if not record.poses:
            continue
        xy = np.array([record.poses[tick] for tick in sorted(record.poses)])
        label = None if record.outcome in labelled else record.outcome
        labelled.add(record.outcome)
        axes.plot(*xy.T, color=OUTCOME_COLOURS[record.outcome], lw=1.6, alpha=0.75, label=label, zorder=3)
        axes.plot(*xy[-1], "x", color=OUTCOME_COLOURS[record.outcome], ms=6, zorder=3)
    # Beside the map, where it hides nothing.
    figure.legend(loc="outside lower center", ncols=6)
    return figure
