"""The look of all figures, and figures that are part of a page with its colours by day and by night."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Sequence
from functools import wraps
from html import escape
from typing import Any, Final, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_P = ParamSpec("_P")
_T = TypeVar("_T")

#: Colours of the page (`html.page`) by day; `svg` has them follow the page.
TEXT, MUTED, LINE, BACK = "#222222", "#5f5f5f", "#dddddd", "#ffffff"
COLOURS: Final = ("#0b5fa5", "#c2410c", "#1a7f37", "#7b1fa2", "#8a6100", "#0e7490")
#: Beside each colour, for those who do not tell colours apart.
DASHES: Final = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
_ON_PAGE: Final = {TEXT: "text", MUTED: "muted", LINE: "line", BACK: "back"} | {
    colour: f"c{number}" for number, colour in enumerate(COLOURS)
}
_STYLE: Final[dict[Any, Any]] = {
    "axes.edgecolor": LINE, "axes.labelcolor": MUTED, "axes.titlecolor": TEXT, "axes.titlesize": 10, "axes.grid": True,
    "axes.axisbelow": True, "axes.spines.right": False, "axes.spines.top": False, "axes.labelsize": 10,
    "figure.constrained_layout.use": True, "font.size": 10, "grid.color": LINE, "grid.linewidth": 0.6,
    "legend.frameon": False, "legend.fontsize": 9, "legend.labelcolor": TEXT, "text.color": TEXT,
    "text.parse_math": False, "xtick.color": LINE, "xtick.labelcolor": MUTED, "ytick.color": LINE,
    "ytick.labelcolor": MUTED, "svg.fonttype": "none", "svg.hashsalt": "smal",
}  # fmt: skip
#: Half of a page, inches: as wide as that it is read on a telephone too.
WIDTH_IN: Final = 5.0


def styled(draw: Callable[_P, _T]) -> Callable[_P, _T]:
    """Have what draws a figure do so in this style."""

    @wraps(draw)
    def drawing(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with mpl.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return drawing


def figure(height_in: float) -> Figure:
    """Return an empty figure, half a page wide."""
    return Figure(figsize=(WIDTH_IN, height_in))


@styled
def svg(drawn: Figure, name: str, said: str) -> str:
    """Return a figure as a part of a page.

    Parameters
    ----------
    drawn
        Made within `styled`.
    name
        Letters; no other figure of the page has it.
    said
        What it shows, for those who do not see it.
    """
    buffer = io.StringIO()
    with warnings.catch_warnings():
        # The browser has letters that the font has not by which the text is measured.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        drawn.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    for colour, variable in _ON_PAGE.items():
        text = text.replace(colour, f"var(--{variable})")
    # Ids are those of the whole page.
    text = re.sub(r'(\sid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(said)}"', 1)


def legend(drawn: Figure, panels: Sequence[Axes], columns: int = 2) -> None:
    """Say below a figure what each kind of mark is, once, if any is named."""
    named: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= {label: handle for handle, label in zip(handles, labels, strict=True) if label not in named}
    if named:
        drawn.legend(list(named.values()), list(named), loc="outside lower center", ncols=columns)
