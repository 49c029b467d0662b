"""The page of results of ``smal run``: one HTML file that needs nothing beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from services.cli.episodes.client import EpisodeRecord
from services.cli.episodes.route_map import draw_routes
from services.experiments.html import image, page, png, source, table, tiles
from services.kit.jpeg import encode_jpeg, shrunk
from smal.files.stored import Stored

#: Camera images shown of the example run.
STRIP: Final = 6


def write_report(
    folder: Path, world: str | None, model: Stored, records: list[EpisodeRecord], summary: Mapping[str, Any]
) -> Path:
    """Write ``index.html`` into a folder and return its path."""
    shown = next((record for record in records if record.outcome == "found"), records[0])
    low, high = summary["wilson_95"]
    latencies_ms = summary["decision_latency_ms"].items()
    latency = {name: "none taken" if ms is None else f"{ms:.0f} ms" for name, ms in latencies_ms}
    routes = "<p>The robot does not tell where it truly is.</p>"
    if any(record.poses for record in records):
        routes = image(png(draw_routes(world, records)), "routes on the map")
    rows = [
        [
            record.outcome,
            *map(str, (record.request.seed, record.ticks, len(record.decisions), len(record.unrecognized))),
        ]
        for record in records
    ]
    parts = [
        tiles(
            {
                "victim found": f"{sum(record.outcome == 'found' for record in records)} of {len(records)}",
                "95 % interval": f"{low:.0%} to {high:.0%}",
                "scheme": model.scheme,
                "decision, median": latency["p50"],
                "decision, 95 %": latency["p95"],
            }
        ),
        "<h2>Where the robot went</h2>",
        routes,
        f"<h2>What it saw on the run with seed {shown.request.seed}</h2>",
        _strip(shown),
        "<h2>How long a decision takes</h2>",
        image(png(_latencies(records)), "decision latency"),
        "<h2>Every run</h2>",
        table(["outcome", "seed", "frames", "decisions", "state unknown"], rows, left=1),
    ]
    path = folder / "index.html"
    path.write_text(page(f"SMAL: {world or records[0].world}, {len(records)} runs", "\n".join(parts)), encoding="utf-8")
    return path


def _latencies(records: list[EpisodeRecord]) -> Figure:
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    axes = figure.add_subplot()
    values = [ms for record in records for ms in record.decision_latencies_ms]
    axes.hist(values, bins=50, color="#1f5fa8")
    axes.set(xlabel="from the last frame's readiness to its command at the actuator (ms)", ylabel="decisions")
    return figure


def _strip(record: EpisodeRecord) -> str:
    ticks = sorted(record.frames)
    if not ticks:
        return "<p>No camera image was kept.</p>"
    figures = []
    for k in np.linspace(0, len(ticks) - 1, min(STRIP, len(ticks))).astype(int):
        view = source(encode_jpeg(shrunk(record.frames[ticks[k]], 320)), "jpeg")
        figures.append(f'<figure><img src="{view}" alt="camera"><figcaption>frame {ticks[k]}</figcaption></figure>')
    return f'<div class="strip">{"".join(figures)}</div>'
