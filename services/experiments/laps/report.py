"""What came out of laps: a page with its figure, and the numbers as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments import html
from services.experiments.drawing import COLOURS, MUTED, figure, legend, styled
from services.experiments.laps.asking import LOST, WITHIN, Judged
from services.experiments.laps.finding import Lap
from smal.files.container import write_whole
from smal.teaching.demonstration import Demonstration

_METHOD = (
    "<p>Each lap is asked from its beginning, which SMAL and teach and repeat are told, while somebody else drives. "
    "Shares are of frames, with 95 % intervals by laps. Lost: with a probability above .5. Wrong and sure: off by more "
    "than a tenth of a lap, lost with a probability below .1. Probabilities are those of being within a tenth of a lap "
    "of the place that is said. The truth is an alignment of each lap with the taught one, by all that came before and "
    "after, by turns and by features that no method here goes by; it is no finer than a frame, and some of it may be "
    "wrong. What a tub does not say is taken so: speed is throttle, and the median lap turns once round. Teach and "
    "repeat is made to steer: asked open loop, it goes on where its wheels pass a goal.</p>"
)


def write_page(
    folder: Path, source: Path, laps: Sequence[tuple[Demonstration, Lap]], judged: dict[str, Judged]
) -> Path:
    """Write ``index.html`` and ``results.json`` into a folder that is there; the first lap taught. Return the page."""
    (taught, _), *asked = laps
    truth = np.concatenate([lap.shows for _, lap in asked])
    facts = {
        "source": str(source),
        "laps": len(laps),
        "taught": taught.name,
        "asked frames": len(truth),
    }
    written = facts | {"methods": {name: one.figures for name, one in judged.items()}}
    write_whole(folder / "results.json", (json.dumps(written, indent=1) + "\n").encode())
    columns = [
        name
        for name in max((one.figures for one in judged.values()), key=len)
        if "95 %" not in name
    ]
    rows = (
        [name, *(_said(one.figures, column) for column in columns)] for name, one in judged.items()
    )
    body = [
        html.table(["", "is"], ([name, str(value)] for name, value in facts.items()), 2),
        html.table(["method", *columns], rows, 1),
        _METHOD,
        html.titled(
            draw(truth, judged),
            "Places, and how reliable probabilities are",
            "Asked laps in their order.",
        ),
    ]
    return html.write_page(folder, "SMAL: laps of a real robot", body, 60)


def _said(figures: dict[str, float | list[float]], name: str) -> str:
    interval = figures.get(f"{name}, 95 %")
    between = " ({:.3f} to {:.3f})".format(*interval) if isinstance(interval, list) else ""
    return f"{figures[name]:.3f}{between}" if name in figures else ""


@styled
def draw(truth: NDArray[np.intp], judged: dict[str, Judged]) -> Figure:
    """Draw what SMAL says beside the truth, one lap after the other, and how often it is right, by its probability."""
    shown = [
        (name, one, one.reliability) for name, one in judged.items() if one.reliability is not None
    ]
    drawn = figure(3.0 + 2.6 * len(shown))
    *panels, last = drawn.subplots(len(shown) + 1, 1)
    last.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=1)
    last.set(xlabel="probability", ylabel="share that is right")
    for axes, (name, one, reliability), colour in zip(panels, shown, COLOURS, strict=False):
        axes.plot(truth, ".", color=MUTED, ms=2, label="truth")
        axes.set(title=name, xlabel="asked frame", ylabel="taught frame")
        kind = np.where(
            one.answers[:, 2] > LOST, 2, one.off > WITHIN
        )  # Lost is 2, wrong 1, right 0.
        for number, (label, mark) in enumerate((("right", "."), ("wrong", "x"), ("lost", "+"))):
            at = np.flatnonzero(kind == number)
            axes.plot(at, one.answers[at, 0], mark, color=COLOURS[2 - number], ms=4, label=label)
        sizes = 20.0 + 300.0 * reliability.count / reliability.count.sum()
        last.scatter(
            reliability.said,
            reliability.right,
            sizes,
            color=colour,
            alpha=0.7,
            label=name,
            zorder=3,
        )
    legend(drawn, [*panels, last])
    return drawn
