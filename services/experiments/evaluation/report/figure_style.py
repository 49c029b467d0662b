"""What the figures of the report have in common."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from services.experiments import html
from services.experiments.evaluation.degradation import degradation_named

OURS, SINGLE = "#0b5fa5", "#d1495b"
PEER_COLOURS: Final = {
    "nearest-1": "#8d99ae",
    "nearest-5": "#5c677d",
    "seqslam-10": "#f2cc8f",
    "seqslam-20": "#e09f3e",
    "seqslam-40": "#b5701a",
}
#: Of those who search.
COLOURS: Final = {
    "smal": OURS,
    "teach-and-repeat": "#e09f3e",
    "paper": SINGLE,
    "nearest-1": "#8d99ae",
    "nearest-5": "#5c677d",
    "seqslam": "#b5701a",
}
PALE: Final = "#9aa5b1"
#: Of degradations, in their order.
CYCLE: Final = (OURS, SINGLE, "#e09f3e", "#5c677d")
_GRID: Final = "#e6e9ec"
_DPI: Final = 130
#: Name, figure and caption (HTML) to what `embed` returns.
Put = Callable[[str, Figure, str], str]


def seen(degradation: str) -> str:
    """Say what is seen under a degradation, as a title that is not wider than its axes."""
    return "clear view" if degradation == "clean" else textwrap.fill(degradation_named(degradation).meaning, 46)


def plain(axes: Axes) -> None:
    """Draw a pale grid, and no frame above and to the right."""
    axes.grid(color=_GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def embed(folder: Path, name: str, figure: Figure, caption: str) -> str:
    """Write a figure as ``NAME.png``, and return it as HTML with its caption, which is HTML too."""
    data = html.png(figure, _DPI)
    (folder / f"{name}.png").write_bytes(data)
    return f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'
