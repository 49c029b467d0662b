"""Common style of all figures."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Final, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from services.experiments.colours import COLOURS, LINE, MUTED, TEXT
from smal.evaluation.precision_recall import PrecisionRecall
from smal.evaluation.reliability import Reliability

_P = ParamSpec("_P")
_T = TypeVar("_T")

DASHES: Final = (
    "-",
    "--",
    "-.",
    ":",
    (0, (5, 1, 1, 1, 1, 1)),
    (0, (8, 2)),
)
_STYLE: Final[dict[Any, Any]] = {
    "axes.edgecolor": LINE, "axes.labelcolor": MUTED, "axes.titlecolor": TEXT, "axes.titlesize": 10, "axes.grid": True,
    "axes.axisbelow": True, "axes.spines.right": False, "axes.spines.top": False, "axes.labelsize": 10,
    "figure.constrained_layout.use": True, "font.size": 10, "grid.color": LINE, "grid.linewidth": 0.6,
    "legend.frameon": False, "legend.fontsize": 9, "legend.labelcolor": TEXT, "text.color": TEXT,
    "text.parse_math": False, "xtick.color": LINE, "xtick.labelcolor": MUTED, "ytick.color": LINE,
    "ytick.labelcolor": MUTED,
}  # fmt: skip
WIDTH_IN: Final = 5.0  # Half a page, inches; readable on a telephone.


def styled(draw: Callable[_P, _T]) -> Callable[_P, _T]:
    """Apply the style to a function that draws a figure."""

    @wraps(draw)
    def drawing(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with mpl.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return drawing


def figure(height_in: float) -> Figure:
    """Return an empty figure, half a page wide."""
    return Figure(figsize=(WIDTH_IN, height_in))


def look_at(
    axes: Axes, points: NDArray[np.float64], bounds: tuple[float, float, float, float]
) -> None:
    """Zoom a map with bounds to points (n, 2) and half their extent; show a small map whole."""
    low = points.min(axis=0)
    high = points.max(axis=0)
    half_m = 0.75 * float((high - low).max())
    middle = (low + high) / 2
    x_min, y_min, x_max, y_max = bounds
    axes.set_xlim(max(x_min, middle[0] - half_m), min(x_max, middle[0] + half_m))
    axes.set_ylim(max(y_min, middle[1] - half_m), min(y_max, middle[1] + half_m))


def draw_curve(axes: Axes, curve: PrecisionRecall, **style: Any) -> None:  # noqa: ANN401
    """Draw precision over recall in steps, as the area counts them; omit a curve without answers."""
    recall = np.concatenate([np.zeros(min(1, curve.recall.size)), curve.recall])
    precision = np.concatenate([curve.precision[:1], curve.precision])
    axes.step(recall, precision, where="pre", **style)
    axes.set(xlabel="recall", ylabel="precision")


def draw_reliability(axes: Axes, reliability: Reliability, **style: Any) -> None:  # noqa: ANN401
    """Draw the share of correct answers over their score; the point size shows the number of answers."""
    axes.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=1)
    sizes = 20.0 + 300.0 * reliability.count / max(int(reliability.count.sum()), 1)
    usual: dict[str, Any] = {"color": COLOURS[0], "clip_on": False, "zorder": 3}
    axes.scatter(reliability.said, reliability.right, sizes, **usual | style)
    axes.set(
        xlim=(0.0, 1.02),
        ylim=(0.0, 1.02),
        xlabel="score",
        ylabel="share of correct answers",
        aspect="equal",
    )
    axes.set_title(f"calibration error {reliability.error:.3f}")


def legend(drawn: Figure, panels: Sequence[Axes], columns: int = 2) -> None:
    """Add a legend below a figure with each label once."""
    named: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= {
            label: handle
            for handle, label in zip(handles, labels, strict=True)
            if label not in named
        }
    if named:
        drawn.legend(list(named.values()), list(named), loc="outside lower center", ncols=columns)
