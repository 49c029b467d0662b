"""Appearance of the target: a test of two hypotheses, calibrated on the taught views.

The filter estimates whether the robot has arrived; this test decides whether the target is in view. It is learned by
`smal.sought.learning`. Each cell of a small picture supports the target as far as it is nearer to the target than to
any other taught view. An unknown cell, unlike both, gives no evidence. The score of a view is the best mean of this
support over a window. The sizes of windows are those of the target during the approach.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.arrays import AnyArray, Float32s, Floats, Int32s
from smal.camera import Image
from smal.features.resizing import SHAPE
from smal.sought.score import SCORES, Said

NUMBERS: Final = 27  # A cell and its eight neighbours, in three colours.
_MOST_CODES: Final = 16_384  # Maximum codes in a file; learning stores fewer.
Codes = NDArray[np.float16]
_ARRAYS: Final = ("sought", "others", "windows", "log_ratio")


def cells_of(picture: Image, step: int = 1) -> Float32s:
    """Return every ``step``-th cell of a small picture, (rows, columns, 27), normalised in brightness."""
    light = picture.astype(np.float32) / max(2.0 * float(picture.mean()), 1.0)
    colours = np.sqrt(np.minimum(light, 1.5))
    edged = np.pad(colours, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows, columns = picture.shape[:2]
    cells = [edged[y : y + rows : step, x : x + columns : step] for y in range(3) for x in range(3)]
    return np.asarray(np.concatenate(cells, axis=-1), dtype=np.float32)


def nearest(cells: Float32s, codes: AnyArray) -> Float32s:
    """Return the distance of each cell (..., 27) from the nearest code (n, 27); infinite without codes."""
    flat = cells.reshape(-1, NUMBERS)
    held = codes.astype(np.float32)
    if not len(held):
        return np.full(cells.shape[:-1], np.inf, dtype=np.float32)
    squares = (held * held).sum(axis=1) - 2.0 * flat @ held.T
    away = squares.min(axis=1) + (flat * flat).sum(axis=1)
    distance = np.sqrt(np.maximum(away, 0.0))
    return np.asarray(distance.reshape(cells.shape[:-1]), dtype=np.float32)


class Window(NamedTuple):
    """Window of a picture with the most support for the target."""

    #: Mean support of its cells, 0 to 1.
    score: float
    #: Left of the middle of the picture, as a share of the width, -0.5 to 0.5.
    left: float
    #: Centre of the support below the middle, as a share of the height, -0.5 to 0.5.
    low: float


@dataclass(frozen=True)
class TargetConfig:
    """Parameters of learning and detecting the target."""

    #: Time of driving before the end of a drive in which the target can be visible.
    approach_s: float = 4.0
    #: Time of driving within which views show the same objects.
    beside_s: float = 3.0
    #: Number of views of the way that are compared with others.
    explaining: int = 60
    #: Quantile of the distances of the way's cells from the rest of the way: a cell with a larger distance stands out.
    stands_out: float = 0.98
    #: The same, for the distance of an unlike cell.
    far: float = 0.999
    #: Distance of a cell from the tracked target, as a share of its distance from the way, within which it is alike.
    like: float = 0.7
    #: Number of window sizes.
    sizes: int = 4
    #: Contrast of a picture, of 255, below which it is blank.
    plain: float = 4.0
    #: Minimum of the mean score without the target in view, as a share of the best score of the approach: around the
    #: end there are objects that the way does not show.
    least_score: float = 0.025
    #: Time within which views count as one.
    same_moment_s: float = 0.5
    #: Prior probability that the target is in view, for a robot that has arrived and looks around.
    in_view: float = 0.2
    #: Cost of a false report of the target, over the cost of continuing to look.
    false_seen: float = 40.0
    #: Height of the target below the middle of the view, at the end of the way, from which it indicates the distance.
    low: float = 0.1


TARGET_CONFIG: Final = TargetConfig()


@dataclass(frozen=True, eq=False)
class Sight:
    """Codes of the target and of everything else, and the calibration of the score."""

    #: Cells (n, 27) of the target.
    sought: Codes
    #: Cells (m, 27) of all other taught views.
    others: Codes
    #: (s, 2) rows and columns of windows, in cells of every second row and column.
    windows: Int32s
    #: Distance from which two cells are completely unlike.
    far: float
    #: (201,) log p(score | in view) - log p(score | not) at `SCORES`, ascending.
    log_ratio: Floats
    #: Sum of the support of all cells where the ways ended.
    size: float
    #: Height below the middle of the view there, as a share of the height, negative above; 0 if it does not indicate
    #: the distance.
    low: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together: they can come from a file."""
        codes = {"sought": self.sought, "others": self.others}
        fits = {
            name: cells.ndim == 2 and cells.shape[1] == NUMBERS and 0 < len(cells) <= _MOST_CODES
            for name, cells in codes.items()
        }
        windows = self.windows
        fits |= {
            "windows": windows.ndim == 2
            and windows.shape[1:] == (2,)
            and windows.dtype.kind == "i"
            and bool(((windows > 0) & (windows <= np.array(SHAPE) // 2)).all())
            and 0 < len(windows) <= TARGET_CONFIG.sizes,
            "far": 1e-6 < self.far < 1e3,
            "size": 0.0 < self.size < 1e4,
            "low": -0.5 <= self.low <= 0.5,
            "log_ratio": self.log_ratio.shape == SCORES.shape
            and bool((np.abs(self.log_ratio) < 1e3).all()),
        }
        wrong = [name for name, fit in fits.items() if not fit]
        finite = all(
            cells.dtype.kind == "f" and (np.abs(cells) < 1e3).all() for cells in codes.values()
        )
        if wrong or not finite:
            raise ValueError(
                f"the parts of the target do not fit together: {', '.join(wrong) or 'cells'}"
            )

    def says(self, picture: Image) -> Said | None:
        """Return the evidence of a small picture; None for a blank picture."""
        if float(picture.std()) < TARGET_CONFIG.plain:
            return None
        support = speaking(cells_of(picture, 2), self.sought, self.others, self.far)
        found = best_window(support, self.windows)
        log_ratio = float(np.interp(found.score, SCORES, self.log_ratio))
        # An area falls with the square of the distance.
        near = math.sqrt(float(support.sum()) / self.size)
        # From another side less of the target looks alike. But for a level camera, an object at a fixed height moves
        # away from the middle of the view as it comes nearer.
        if self.low:
            near = max(near, found.low / self.low)
        return Said(log_ratio, near, found.left)


def speaking(cells: Float32s, sought: AnyArray, others: AnyArray, far: float) -> Float32s:
    """Return the support of each cell for the target, 0 to 1."""
    to_target = np.minimum(nearest(cells, sought), far)
    to_others = np.minimum(nearest(cells, others), far)
    support: Float32s = np.maximum(to_others - to_target, 0.0) / far
    return support


def best_window(speaks: Float32s, windows: Int32s) -> Window:
    """Return the window of the highest mean; its score is 0 without any support."""
    total = np.pad(speaks, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    best = Window(0.0, 0.0, 0.0)
    for rows, columns in windows.tolist():
        inside = (
            total[rows:, columns:]
            - total[:-rows, columns:]
            - total[rows:, :-columns]
            + total[:-rows, :-columns]
        )
        mean = float(inside.max()) / (rows * columns)
        if mean > best.score:
            row, column = divmod(int(inside.argmax()), inside.shape[1])
            by_row = speaks[row : row + rows, column : column + columns].sum(axis=1)
            middle = row + 0.5 + float(by_row @ np.arange(rows) / by_row.sum())
            left = 0.5 - (column + columns / 2.0) / speaks.shape[1]
            best = Window(mean, left, middle / speaks.shape[0] - 0.5)
    return best._replace(score=min(best.score, 1.0))


def content_of_sights(
    sights: Mapping[str, Sight],
) -> tuple[list[dict[str, Any]], dict[str, AnyArray]]:
    """Return the metadata and the arrays of the sights of goals."""
    meta = []
    arrays = dict[str, AnyArray]()
    for number, (goal, sight) in enumerate(sights.items()):
        meta.append({"goal": goal, "far": sight.far, "size": sight.size, "low": sight.low})
        arrays |= {f"{name} {number}": getattr(sight, name) for name in _ARRAYS}
    return meta, arrays


def sights_of_content(meta: list[dict[str, Any]], arrays: dict[str, AnyArray]) -> dict[str, Sight]:
    """Build the sights of goals from a file; LookupError, TypeError or ValueError if the content is invalid."""
    sights = {}
    for number, part in enumerate(meta):
        parts = {name: arrays.pop(f"{name} {number}") for name in _ARRAYS}
        sights[str(part["goal"])] = Sight(
            far=part["far"], size=part["size"], low=part["low"], **parts
        )
    return sights
