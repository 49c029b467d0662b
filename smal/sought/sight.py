"""Whether what a drive led to is in view: a test of two hypotheses that are calibrated on what was taught.

"Arrived" says where the robot is; this says whether what it was sent to find is there (`smal.sought.learning` learns
what that is). Each cell of a small picture speaks for it as far as it is nearer to what is sought than to anything else
that was taught; what is new and like neither says nothing. A view's score is the best mean of that over a window of one
of the sizes that the approach had.
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
_MOST_CODES: Final = 16_384  # Codes that a file may hold; learning keeps fewer.
Codes = NDArray[np.float16]
_ARRAYS: Final = ("sought", "others", "windows", "log_ratio")


def cells_of(picture: Image, step: int = 1) -> Float32s:
    """Return every ``step``-th cell of a small picture, (rows, columns, 27): as if it were as bright as any."""
    light = picture.astype(np.float32) / max(2.0 * float(picture.mean()), 1.0)
    seen = np.sqrt(np.minimum(light, 1.5))
    edged = np.pad(seen, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows, columns = picture.shape[:2]
    each = [edged[y : y + rows : step, x : x + columns : step] for y in range(3) for x in range(3)]
    return np.asarray(np.concatenate(each, axis=-1), dtype=np.float32)


def nearest(cells: Float32s, codes: AnyArray) -> Float32s:
    """Return how far each cell (..., 27) is from the nearest of some codes (n, 27); infinitely, if there are none."""
    flat = cells.reshape(-1, NUMBERS)
    held = codes.astype(np.float32)
    if not len(held):
        return np.full(cells.shape[:-1], np.inf, dtype=np.float32)
    squares = (held * held).sum(axis=1) - 2.0 * flat @ held.T
    away = squares.min(axis=1) + (flat * flat).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(away, 0.0)).reshape(cells.shape[:-1]), dtype=np.float32)


class Window(NamedTuple):
    """Where in a picture most speaks for what is sought."""

    score: float  # Mean of what its cells say, 0 to 1.
    left: float  # Of the middle of the picture, as a share of the width, -0.5 to 0.5.
    low: float  # Below the middle what speaks is, as a share of the height, -0.5 to 0.5.


@dataclass(frozen=True)
class TargetConfig:
    """Numbers by which the target is learned and seen."""

    #: Time of driving before the end of a drive in which the target may be seen well.
    approach_s: float = 4.0
    beside_s: float = 3.0  # Time of driving within which views show the same things.
    explaining: int = 60  # Views of the way that explain others.
    #: Share of the cells of the way that are nearer to the rest of it: a cell that is less near stands out.
    stands_out: float = 0.98
    far: float = 0.999  # The same, for a cell that is not alike.
    #: Share of how far a cell is from the way within which it is like what is followed.
    like: float = 0.7
    sizes: int = 4  # Windows of different sizes.
    plain: float = 4.0  # Contrast of a picture, of 255, below which it shows nothing.
    #: Mean score without the target in view, at least, as a share of the best one of the approach: round the end there
    #: are things that the way does not show.
    least_score: float = 0.025
    same_moment_s: float = 0.5  # Views of so long a time count together as one.
    #: Probability that the target is in view of a robot that has arrived and looks around.
    in_view: float = 0.2
    false_seen: float = 40.0  # How much worse a false report of the target is than to look on.
    low: float = 0.1  # How low in the view it is shows how near it is, where that is so much at the end of the way.


TARGET_CONFIG: Final = TargetConfig()


@dataclass(frozen=True, eq=False)
class Sight:
    """What is sought, what else there is, and what a score says."""

    sought: Codes  # Cells (n, 27) of what is sought, and (m, 27) of all else that was taught.
    others: Codes
    windows: (
        Int32s  # (s, 2), rows and columns that it took, in cells of every second row and column.
    )
    far: float  # Distance from which two cells are not alike at all.
    log_ratio: Floats  # (201,) log p(score | in view) - log p(score | not) at `SCORES`, ascending.
    size: float  # Cells that spoke for it where the ways ended.
    #: How far below the middle of the view it was there, as a share of the height, above is negative; 0 where this does
    #: not tell how near it is.
    low: float = 0.0

    def __post_init__(self) -> None:
        """ValueError where parts do not fit together: they may come from a file."""
        codes = {"sought": self.sought, "others": self.others}
        fits = {
            name: one.ndim == 2 and one.shape[1] == NUMBERS and 0 < len(one) <= _MOST_CODES
            for name, one in codes.items()
        }
        fits |= {
            "windows": self.windows.ndim == 2
            and self.windows.shape[1:] == (2,)
            and self.windows.dtype.kind == "i"
            and bool(((self.windows > 0) & (self.windows <= np.array(SHAPE) // 2)).all())
            and 0 < len(self.windows) <= TARGET_CONFIG.sizes,
            "far": 1e-6 < self.far < 1e3,
            "size": 0.0 < self.size < 1e4,
            "low": -0.5 <= self.low <= 0.5,
            "log_ratio": self.log_ratio.shape == SCORES.shape
            and bool((np.abs(self.log_ratio) < 1e3).all()),
        }
        wrong = [name for name, fit in fits.items() if not fit]
        if wrong or not all(
            one.dtype.kind == "f" and (np.abs(one) < 1e3).all() for one in codes.values()
        ):
            raise ValueError(
                f"the parts of what is sought do not fit together: {', '.join(wrong) or 'cells'}"
            )

    def says(self, picture: Image) -> Said | None:
        """Return what a small picture says; None where nothing shows."""
        if float(picture.std()) < TARGET_CONFIG.plain:
            return None
        speaks = speaking(cells_of(picture, 2), self.sought, self.others, self.far)
        found = best_window(speaks, self.windows)
        log_ratio = float(np.interp(found.score, SCORES, self.log_ratio))
        # An area falls with the square of the distance.
        near = math.sqrt(float(speaks.sum()) / self.size)
        # From another side less of it looks as it did; but what stands at one height is the lower, or higher, in the
        # view of a level camera the nearer it is.
        return Said(log_ratio, max(near, found.low / self.low) if self.low else near, found.left)


def speaking(cells: Float32s, sought: AnyArray, others: AnyArray, far: float) -> Float32s:
    """Return how much each cell speaks for what is sought, 0 to 1."""
    ours = nearest(cells, sought)
    theirs = nearest(cells, others)
    speaks: Float32s = np.maximum(np.minimum(theirs, far) - np.minimum(ours, far), 0.0) / far
    return speaks


def best_window(speaks: Float32s, windows: Int32s) -> Window:
    """Return the window of the highest mean; its score is 0 where nothing speaks."""
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
    """Return what a file says of the sights of goals, and the arrays in it."""
    said = []
    arrays = dict[str, AnyArray]()
    for number, (goal, one) in enumerate(sights.items()):
        said.append({"goal": goal, "far": one.far, "size": one.size, "low": one.low})
        arrays |= {f"{name} {number}": getattr(one, name) for name in _ARRAYS}
    return said, arrays


def sights_of_content(said: list[dict[str, Any]], arrays: dict[str, AnyArray]) -> dict[str, Sight]:
    """Take the sights of goals out of what a file says; LookupError, TypeError or ValueError where that is wrong."""
    found = {}
    for number, one in enumerate(said):
        parts = {name: arrays.pop(f"{name} {number}") for name in _ARRAYS}
        found[str(one["goal"])] = Sight(far=one["far"], size=one["size"], low=one["low"], **parts)
    return found
