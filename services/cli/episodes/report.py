"""The page of results of ``smal run``: one HTML file that needs nothing beside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.cli.episodes.client import EpisodeRecord
from services.cli.episodes.route_map import OUTCOME_COLOURS, draw_routes
from services.experiments.html import image, page, png, source, tiles
from services.kit.jpeg import encode_jpeg, shrunk
from smal.files.stored import Stored

#: Camera images shown of the example run.
STRIP: Final = 6


def write_report(
    folder: Path, world: str | None, model: Stored, records: list[EpisodeRecord], summary: Mapping[str, object]
) -> Path:
    """Write ``index.html`` into a folder and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    shown = next((record for record in records if record.outcome == "found"), records[0])
    parts = [
        _tiles(model, records, summary),
        "<h2>Where the robot went</h2>",
        _routes(world, records),
        f"<h2>What it saw on the run with seed {shown.request.seed}</h2>",
        _strip(shown),
        "<h2>How long a decision takes</h2>",
        _picture(_latencies(records), "decision latency"),
        "<h2>Every run</h2>",
        _table(records),
    ]
    path = folder / "index.html"
    path.write_text(page(f"SMAL: {world or records[0].world}, {len(records)} runs", "\n".join(parts)), encoding="utf-8")
    return path


def _routes(world: str | None, records: list[EpisodeRecord]) -> str:
    if not any(record.poses for record in records):
        return "<p>The robot does not tell where it truly is.</p>"
    return _picture(draw_routes(world, records), "routes on the map")


def _tiles(model: Stored, records: list[EpisodeRecord], summary: Mapping[str, object]) -> str:
    found = sum(record.outcome == "found" for record in records)
    low, high = np.array(summary["wilson_95"])
    latency = summary["decision_latency_ms"]
    assert isinstance(latency, dict)  # noqa: S101 - made by run.summarize
    p50, p95 = (f"{latency[key]:.0f} ms" if latency[key] is not None else "none taken" for key in ("p50", "p95"))
    values = {
        "victim found": f"{found} of {len(records)}",
        "95 % interval": f"{low:.0%} to {high:.0%}",
        "scheme": model.scheme,
        "decision, median": p50,
        "decision, 95 %": p95,
    }
    return tiles(values)


def _latencies(records: Iterable[EpisodeRecord]) -> Figure:
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
    chosen = [ticks[i] for i in np.linspace(0, len(ticks) - 1, min(STRIP, len(ticks))).astype(int)]
    figures = (
        f'<figure><img src="{_jpeg(record.frames[tick])}" alt="camera"><figcaption>frame {tick}</figcaption></figure>'
        for tick in chosen
    )
    return f'<div class="strip">{"".join(figures)}</div>'


def _table(records: Iterable[EpisodeRecord]) -> str:
    rows = "".join(
        f"<tr><td>{r.request.seed}</td>"
        f'<td class="text"><span style="color:{OUTCOME_COLOURS[r.outcome]}">●</span> {r.outcome}</td>'
        f"<td>{r.ticks}</td><td>{len(r.decisions)}</td><td>{r.unknown}</td></tr>"
        for r in records
    )
    head = "".join(f"<th>{name}</th>" for name in ("seed", "outcome", "frames", "decisions", "state unknown"))
    return f"<table><tr>{head}</tr>{rows}</table>"


def _picture(figure: Figure, alt: str) -> str:
    return image(png(figure), alt)


def _jpeg(view: NDArray[np.uint8]) -> str:
    return source(encode_jpeg(shrunk(view, 320)), "jpeg")
