"""Page of results of ``smal run``, with the routes of the episodes on a map."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from schemas.codec import printable
from schemas.episode import in_words
from services.cli.episodes.client import EpisodeRecord
from services.experiments import html
from services.experiments.drawing import legend, look_at
from services.experiments.words import condition
from services.simulator.world import World, known_worlds, load_world
from services.simulator.world.map_view import draw_map
from smal.files.stored import Stored

THING_COLOUR: Final = "#d6602d"
OUTCOME_COLOURS: Final = {
    "found": "#1a7f37", "collision": "#c62828", "timeout": "#b26a00", "false_goal": "#7b1fa2", "aborted": "#666666",
    "missed": "#c98f00", "not_here": "#1565c0",
}  # fmt: skip


def write_report(
    folder: Path,
    world: str | None,
    model: tuple[Path, Stored],
    records: list[EpisodeRecord],
    summary: Mapping[str, Any],
) -> Path:
    """Write ``index.html`` into a folder and return its path."""
    shown = next((record for record in records if record.outcome == "found"), records[0])
    ticks = sorted(shown.frames)
    low, high = summary["wilson_95"]
    latency = {
        name: "not measured" if ms is None else f"{ms:.0f} ms"
        for name, ms in summary["decision_latency_ms"].items()
    }
    has_poses = any(record.poses for record in records)
    there = known_world(world, records)
    file, learned = model
    taught_in = getattr(learned, "world", "")

    def to_goal(one: EpisodeRecord) -> str:
        if there is None or not one.poses:
            return "-"
        return f"{math.dist(one.poses[max(one.poses)], (there.victim.x, there.victim.y)):.1f}"

    return html.write_page(
        folder,
        "run.html",
        world=world or records[0].world,
        facts={
            "victim found": f"{sum(one.outcome == 'found' for one in records)} of {len(records)}",
            "95 % interval": f"{low:.0%} to {high:.0%}",
            "scheme": learned.scheme,
            "conditions": condition(vars(records[0].request)),
            "decision, median": latency["p50"],
            "decision, 95 %": latency["p95"],
        },
        routes=html.png(draw_routes(there, records)) if has_poses else None,
        shown=shown,
        model=f"{printable(str(file))}, checksum {learned.checksum[:12]}"
        + (f", taught in {printable(taught_in)}" if taught_in else ""),
        to_goal=to_goal,
        photos={f"{shown.seconds(tick):.0f} s, frame {tick}": shown.frames[tick] for tick in ticks},
        records=records,
        in_words=in_words,
    )


def draw_routes(there: World | None, records: Sequence[EpisodeRecord]) -> Figure:
    """Draw the routes of the episodes, coloured by outcome, on the map of their world if known."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.add_subplot()
    seen: list[NDArray[np.float64]] = []
    for outline in dict.fromkeys(outline for record in records for outline in record.things):
        axes.fill(
            *np.array(outline).T,
            color=THING_COLOUR,
            lw=0,
            alpha=0.6,
            label="added, in one run",
            zorder=2.5,
        )
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
        look_at(axes, np.concatenate(seen), there.place.bounds)
    legend(figure, [axes], 6)
    return figure


def known_world(world: str | None, records: Sequence[EpisodeRecord]) -> World | None:
    """Return the requested world, or an included world that the robot names, but never its path."""
    name = world or (records[0].world if records[0].world in known_worlds() else None)
    return None if name is None else load_world(name)
