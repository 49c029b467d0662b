"""Page of results on laps with its figure, and the numbers as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments import html
from services.experiments.colours import COLOURS, MUTED
from services.experiments.drawing import draw_reliability, figure, legend, styled
from services.experiments.laps.asking import LOST, WITHIN, Judged
from services.experiments.laps.finding import Lap
from smal.files.container import write_whole
from smal.teaching.demonstration import Demonstration


def write_page(
    folder: Path, source: Path, laps: Sequence[tuple[Demonstration, Lap]], judged: dict[str, Judged]
) -> Path:
    """Write ``index.html`` and ``results.json`` into an existing folder; return the page."""
    (taught, _), *asked = laps
    truth = np.concatenate([lap.shows for _, lap in asked])
    facts = {
        "source": str(source),
        "laps": len(laps),
        "taught": taught.name,
        "localized frames": len(truth),
    }
    written = facts | {"methods": {name: one.figures for name, one in judged.items()}}
    write_whole(folder / "results.json", (json.dumps(written, indent=1) + "\n").encode())
    most = max((one.figures for one in judged.values()), key=len)
    return html.write_page(
        folder,
        "laps.html",
        facts=facts,
        columns=[name for name in most if "95 %" not in name],
        methods=written["methods"],
        picture=html.png(draw(truth, judged)),
    )


@styled
def draw(truth: NDArray[np.intp], judged: dict[str, Judged]) -> Figure:
    """Draw the answers of SMAL and the ground truth, lap by lap, and the reliability diagram."""
    shown = [
        (name, one, one.reliability) for name, one in judged.items() if one.reliability is not None
    ]
    drawn = figure(3.0 + 2.6 * len(shown))
    *panels, last = drawn.subplots(len(shown) + 1, 1)
    for axes, (name, one, reliability), colour in zip(panels, shown, COLOURS, strict=False):
        axes.plot(truth, ".", color=MUTED, ms=2, label="truth")
        axes.set(title=name, xlabel="query frame", ylabel="taught frame")
        # Lost is 2, wrong 1, correct 0.
        kind = np.where(one.answers[:, 2] > LOST, 2, one.off > WITHIN)
        for number, (label, mark) in enumerate((("right", "."), ("wrong", "x"), ("lost", "+"))):
            at = np.flatnonzero(kind == number)
            axes.plot(at, one.answers[at, 0], mark, color=COLOURS[2 - number], ms=4, label=label)
        draw_reliability(last, reliability, color=colour, alpha=0.7, label=name)
    last.set(xlabel="probability", aspect="auto", title="")
    legend(drawn, [*panels, last])
    return drawn
