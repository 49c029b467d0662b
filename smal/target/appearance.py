"""Appearance of the target: the ratio of nearest distances, calibrated on the taught views.

Each cell of a small picture supports the target by the logarithm of the ratio of its distances from
all other taught views and from the target (Lowe 2004), if it is nearer to the target. An unknown cell
is far from both, and a plain one near to both, so that neither counts. The score of a view is the best
mean over a window. The sizes of windows are the sizes of the target during the approach.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.arrays import AnyArray, Float32s, Int32s
from smal.camera import Image
from smal.features.cells import NUMBERS, cells_of, nearest
from smal.features.resizing import SHAPE
from smal.target.distance import Distance
from smal.target.evidence import ScoreEvidence, Sighting

#: Number of window sizes.
SIZES: Final = 4
_MOST_CODES: Final = 16_384  # Maximum codes in a file; learning stores fewer.
_ARRAYS: Final = ("target", "others", "windows")
#: Distance by noise and compression, added to both distances: a fifteenth of a cell's usual length.
_EQUAL: Final = 0.1


@dataclass(frozen=True)
class TargetConfig:
    """Parameters of learning and detecting the target. Times are seconds of driving."""

    #: Time before the end of a drive in which the target can be visible: from further away it is
    #: smaller than a cell.
    approach_s: float = 4.0
    #: Time, by the clock, within which views count as one.
    moment_s: float = 0.5
    #: Share of the cells of the way that are nearer to the rest of the way than a new cell: a
    #: target covers about a fiftieth of a view.
    known: float = 0.98
    #: Probability from which the target counts as in view: a false report costs the search.
    sure: float = 0.975
    #: Usual distance from the end of a drive to its target, where the drive itself shows none.
    end_s: float = 1.5

    @property
    def beside_s(self) -> float:
        """Time within which views show the same objects: `approach_s` without the last second."""
        return self.approach_s - 1.0


TARGET_CONFIG: Final = TargetConfig()


def lower_quantile(distances: AnyArray, share: float) -> float:
    """Return the distance that this share of the distances is below; some can be infinite.

    `np.quantile` interpolates, which has no result between infinite distances.
    """
    rank = int(share * (distances.size - 1))
    return float(np.partition(distances, rank, axis=None)[rank])


@dataclass(frozen=True, eq=False)
class Compared:
    """A picture compared with the target and with all other views: distances of its cells."""

    to_target: Float32s
    to_others: Float32s

    @classmethod
    def of(cls, cells: Float32s, target: AnyArray, others: AnyArray) -> "Compared":
        """Compare cells (rows, columns, 27)."""
        return cls(nearest(cells, target) + _EQUAL, nearest(cells, others) + _EQUAL)

    @property
    def unlike(self) -> float:
        """Distance from everything taught, of the quarter of the cells with the smallest distance."""
        return lower_quantile(np.minimum(self.to_target, self.to_others), 0.25)

    def window(self, windows: Int32s) -> "Window":
        """Return the window with the highest score."""
        support = np.maximum(np.log(self.to_others / self.to_target), 0.0)
        found = []
        for rows, columns in windows.tolist():
            mean = _sums(support, rows, columns) / (rows * columns)
            row, column = divmod(int(mean.argmax()), mean.shape[1])
            inside = slice(row, row + rows), slice(column, column + columns)
            found.append(Window(float(mean.max()), inside))
        return max(found, key=lambda window: window.score)

    def extent(self, window: "Window", usual: float) -> "Extent":
        """Return the extent of the target, given the best window and its usual score.

        The target covers the cells whose ratio is above the middle between the usual score and
        that of the window. Light and noise move both, so that they hardly change the size.
        """
        import cv2  # noqa: PLC0415 - see `smal.features.resizing`

        ratio = np.log(cv2.blur(self.to_others, (3, 3)) / cv2.blur(self.to_target, (3, 3)))
        best = float(ratio[window.inside].max())
        above = ratio >= min((window.score + usual) / 2.0, best)
        inside = np.zeros_like(above)
        inside[window.inside] = above[window.inside]
        low, right = (np.argwhere(inside).mean(axis=0) + 0.5) / inside.shape - 0.5
        cut = above[-1 if low > 0.0 else 0, window.inside[1]].any()
        return Extent(math.sqrt(above.sum()), float(low), -float(right), bool(cut))


class Window(NamedTuple):
    """Window of a picture."""

    #: Mean log of the distance from the other views over the distance from the target.
    score: float
    inside: tuple[slice, slice]


class Extent(NamedTuple):
    """Extent of the target in a picture."""

    #: Root of the area, in cells.
    size: float
    #: Centre below, and left of, the middle of the picture, as shares of its height and width.
    low: float
    left: float
    #: Whether the border cuts it through which it leaves the view of a camera that comes nearer.
    cut: bool


@dataclass(frozen=True, eq=False)
class TargetAppearance:
    """Codes of the target and of everything else, and the calibration of score and distance."""

    #: Cells (n, 27) of the target.
    target: NDArray[np.float16]
    #: Cells (m, 27) of all other taught views.
    others: NDArray[np.float16]
    #: (s, 2) rows and columns of windows, in cells of every second row and column.
    windows: Int32s
    #: Largest `Compared.unlike` of the way.
    unlike: float
    evidence: ScoreEvidence
    distance: Distance

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together: they can come from a file."""
        codes = {"target": self.target, "others": self.others}
        fits = {
            name: cells.ndim == 2
            and cells.shape[1] == NUMBERS
            and 0 < len(cells) <= _MOST_CODES
            and cells.dtype.kind == "f"
            and bool((np.abs(cells) < 1e3).all())
            for name, cells in codes.items()
        }
        windows = self.windows
        fits["windows"] = (
            windows.ndim == 2
            and windows.shape[1:] == (2,)
            and windows.dtype.kind == "i"
            and bool(((windows > 0) & (windows <= np.array(SHAPE) // 2)).all())
            and 0 < len(windows) <= SIZES
        )
        fits["unlike"] = 0.0 < self.unlike < 1e3
        wrong = [name for name, fit in fits.items() if not fit]
        if wrong:
            raise ValueError(f"the parts of the target do not fit together: {', '.join(wrong)}")

    def detect(self, picture: Image) -> Sighting:
        """Return the evidence of a small picture."""
        compared = Compared.of(cells_of(picture, 2), self.target, self.others)
        window = compared.window(self.windows)
        noise = max(1.0 - (self.unlike / compared.unlike) ** 2, 0.0)
        extent = compared.extent(window, self.evidence.usual)
        log_near, error = self.distance.log_near(extent.size, extent.low)
        log_ratio = self.evidence.log_ratio(window.score, noise)
        return Sighting(log_ratio, log_near, error, extent.left, extent.cut)


def _sums(cells: Float32s, rows: int, columns: int) -> NDArray[np.float64]:
    """Return the sum over each window of `rows` and `columns`."""
    total = np.pad(cells, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    below = total[rows:, columns:] - total[rows:, :-columns]
    above = total[:-rows, columns:] - total[:-rows, :-columns]
    return np.asarray(below - above)


def content_of_appearances(
    appearances: Mapping[str, TargetAppearance],
) -> tuple[list[dict[str, Any]], dict[str, AnyArray]]:
    """Return the metadata and the arrays of the appearances of goals."""
    meta = []
    arrays = dict[str, AnyArray]()
    for number, (goal, appearance) in enumerate(appearances.items()):
        calibration = {
            "evidence": asdict(appearance.evidence),
            "distance": asdict(appearance.distance),
        }
        meta.append({"goal": goal, "unlike": appearance.unlike} | calibration)
        arrays |= {f"{name} {number}": getattr(appearance, name) for name in _ARRAYS}
    return meta, arrays


def appearances_of_content(
    meta: list[dict[str, Any]], arrays: dict[str, AnyArray]
) -> dict[str, TargetAppearance]:
    """Build the appearances of goals from a file; LookupError, TypeError or ValueError if the content is invalid."""
    appearances = {}
    for number, part in enumerate(meta):
        parts = {name: arrays.pop(f"{name} {number}") for name in _ARRAYS}
        evidence = ScoreEvidence(**part["evidence"])
        distance = Distance(**part["distance"])
        appearances[str(part["goal"])] = TargetAppearance(
            unlike=part["unlike"], evidence=evidence, distance=distance, **parts
        )
    return appearances
