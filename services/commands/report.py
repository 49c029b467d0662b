"""The page of results of ``smal run``: one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.commands.episodes import EpisodeRecord
from services.commands.route_map import OUTCOME_COLOURS, draw_routes
from smal.model import Model

#: Camera images shown of the example run.
STRIP: Final = 6


def write_report(
    folder: Path, world: str, model: Model, records: list[EpisodeRecord], summary: Mapping[str, object]
) -> Path:
    """Write ``index.html`` into a folder and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    shown = next((record for record in records if record.outcome == "found"), records[0])
    parts = [
        _tiles(model, records, summary),
        "<h2>Where the robot went</h2>",
        _picture(draw_routes(world, records), "routes on the map"),
        f"<h2>What it saw on the run with seed {shown.request.seed}</h2>",
        _strip(shown),
        "<h2>How long a decision takes</h2>",
        _picture(_latencies(records), "decision latency"),
        "<h2>Every run</h2>",
        _table(records),
    ]
    page = folder / "index.html"
    title = f"SMAL: {html.escape(world)}, {len(records)} runs"
    page.write_text(_PAGE.format(title=title, body="\n".join(parts)), encoding="utf-8")
    return page


def _tiles(model: Model, records: list[EpisodeRecord], summary: Mapping[str, object]) -> str:
    found = sum(record.outcome == "found" for record in records)
    low, high = np.array(summary["wilson_95"])
    latency = summary["decision_latency_ms"]
    assert isinstance(latency, dict)  # noqa: S101 - made by run.summarise
    p50, p95 = (f"{latency[key]:.0f} ms" if latency[key] is not None else "none taken" for key in ("p50", "p95"))
    tiles = {
        "victim found": f"{found} of {len(records)}",
        "95 % interval": f"{low:.0%} to {high:.0%}",
        "states": str(model.states),
        "shared by demonstrations": str(model.shared_states),
        "actions": str(len(model.actions)),
        "decision, median": p50,
        "decision, 95 %": p95,
    }
    cells = "".join(f"<div><b>{value}</b><span>{name}</span></div>" for name, value in tiles.items())
    return f'<div class="tiles">{cells}</div>'


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
        f'<td style="color:{OUTCOME_COLOURS[r.outcome]}">{r.outcome}</td>'
        f"<td>{r.ticks}</td><td>{len(r.decisions)}</td><td>{r.unknown}</td></tr>"
        for r in records
    )
    head = "".join(f"<th>{name}</th>" for name in ("seed", "outcome", "frames", "decisions", "state unknown"))
    return f"<table><tr>{head}</tr>{rows}</table>"


def _picture(figure: Figure, alt: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img class="wide" src="data:image/png;base64,{data}" alt="{alt}">'


def _jpeg(image: NDArray[np.uint8]) -> str:
    height, width, _ = image.shape
    small = cv2.resize(image, (320, round(320 * height / width)), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; }} h2 {{ font-size: 1.15rem; margin-top: 2rem; }}
.tiles {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(8rem, 1fr)); gap: .6rem; }}
.tiles div {{ border: 1px solid #ddd; border-radius: .5rem; padding: .6rem .8rem; }}
.tiles b {{ display: block; font-size: 1.3rem; }} .tiles span {{ color: #666; font-size: .85rem; }}
.wide {{ width: 100%; }}
.strip {{ display: grid; grid-template-columns: repeat(3, 1fr); gap: .5rem; }}
.strip figure {{ margin: 0; }} .strip img {{ width: 100%; border-radius: .3rem; }}
figcaption {{ color: #666; font-size: .85rem; }}
table {{ border-collapse: collapse; }} th, td {{ text-align: right; padding: .2rem .9rem; }}
td {{ border-bottom: 1px solid #eee; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""
