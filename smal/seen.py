"""Whether what a drive led to is in view: a test of two hypotheses that are calibrated on what was taught.

"Arrived" says where the robot is; this says whether what it was sent to find is there. A drive ends before it. What of
the last views the way before does not explain is what is looked for: cells of a small picture that are further from all
that the way shows than nearly any cell of the way is from the rest of it, in one piece, ahead. From the last view it is
followed back over the approach, so that it is known at several sizes.

In a run each cell of the view speaks for it as far as it is nearer to what is sought than to anything else that was
taught; what is new and like neither says nothing. A view's score is the best mean of that over a window of one of the
sizes that the approach had. Scores of the approach, each view left out of what is sought, say what to expect where it
is in view; scores of the way, each view's neighbourhood left out of what explains it, what to expect where it is not.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.camera import Image
from smal.features.picture import SHAPE
from smal.likelihood import evenly, log_ratio
from smal.settings import SETTINGS

#: What scores are tabulated for.
SCORES: Final = np.linspace(0.0, 1.0, 201)
#: A cell and its eight neighbours, in three colours.
_NUMBERS: Final = 27
#: Cells that are taken of a view of the way, as what explains others; of the approach, beside what is sought; of that.
_CODES, _BESIDE, _SOUGHT = 32, 128, 24
#: Cells that are the least to be looked for.
_FEWEST: Final = 8
#: Codes that a file may hold; learning keeps fewer.
_MOST_CODES: Final = 16_384
#: Rows and columns that a window has at least: fewer cells look like anything.
_LEAST: Final = 3
Codes = NDArray[np.float16]
#: A small picture, its cells (60, 80, 27), and which of these are of what is sought.
Patch = tuple[Image, NDArray[np.float32], NDArray[np.bool_]]
_ARRAYS: Final = ("sought", "others", "windows", "log_ratio")


def cells_of(picture: Image, step: int = 1) -> NDArray[np.float32]:
    """Return every ``step``-th cell of a small picture, (rows, columns, 27): as if it were as bright as any."""
    light = picture.astype(np.float32) / max(2.0 * float(picture.mean()), 1.0)
    seen = np.sqrt(np.minimum(light, 1.5))
    edged = np.pad(seen, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows, columns = picture.shape[:2]
    each = [edged[y : y + rows : step, x : x + columns : step] for y in range(3) for x in range(3)]
    return np.asarray(np.concatenate(each, axis=-1), dtype=np.float32)


def nearest(cells: NDArray[np.float32], codes: NDArray[Any]) -> NDArray[np.float32]:
    """Return how far each cell (..., 27) is from the nearest of some codes (n, 27); infinitely, if there are none."""
    flat, held = cells.reshape(-1, _NUMBERS), codes.astype(np.float32)
    if not len(held):
        return np.full(cells.shape[:-1], np.inf, dtype=np.float32)
    squares = (held * held).sum(axis=1) - 2.0 * flat @ held.T
    away = squares.min(axis=1) + (flat * flat).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(away, 0.0)).reshape(cells.shape[:-1]), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Sight:
    """What is sought, what else there is, and what a score says.

    Parameters
    ----------
    sought, others : float16 arrays (n, 27), (m, 27)
        Cells of what is sought, and of all else that was taught.
    windows : int32 array (s, 2)
        Rows and columns that it took, in cells of every second row and column.
    far : float
        Distance from which two cells are not alike at all.
    log_ratio : float64 array (201,)
        log p(score | in view) - log p(score | not) at `SCORES`, ascending.
    size : float
        Cells that spoke for it where the ways ended.
    """

    sought: Codes
    others: Codes
    windows: NDArray[np.int32]
    far: float
    log_ratio: NDArray[np.float64]
    size: float

    def __post_init__(self) -> None:
        """ValueError where parts do not fit together: they may come from a file."""
        codes = {"sought": self.sought, "others": self.others}
        fits = {
            name: one.ndim == 2 and one.shape[1] == _NUMBERS and 0 < len(one) <= _MOST_CODES
            for name, one in codes.items()
        }
        fits |= {
            "windows": self.windows.ndim == 2
            and self.windows.shape[1:] == (2,)
            and self.windows.dtype.kind == "i"
            and bool(((self.windows > 0) & (self.windows <= np.array(SHAPE) // 2)).all())
            and 0 < len(self.windows) <= SETTINGS.sizes,
            "far": 1e-6 < self.far < 1e3,
            "size": 0.0 < self.size < 1e4,
            "log_ratio": self.log_ratio.shape == SCORES.shape and bool((np.abs(self.log_ratio) < 1e3).all()),
        }
        wrong = [name for name, fit in fits.items() if not fit]
        if wrong or not all(one.dtype.kind == "f" and (np.abs(one) < 1e3).all() for one in codes.values()):
            raise ValueError(f"the parts of what is sought do not fit together: {', '.join(wrong) or 'cells'}")

    def says(self, picture: Image) -> tuple[float, float] | None:
        """Return the log ratio of a small picture, and how many cells speak for it; None where nothing shows."""
        if float(picture.std()) < SETTINGS.plain:
            return None
        speaks = _speaks(cells_of(picture, 2), self.sought, self.others, self.far)
        return float(np.interp(_best(speaks, self.windows), SCORES, self.log_ratio)), float(speaks.sum())


def _speaks(cells: NDArray[np.float32], sought: NDArray[Any], others: NDArray[Any], far: float) -> NDArray[np.float32]:
    """Return how much each cell speaks for what is sought, 0 to 1."""
    ours, theirs = nearest(cells, sought), nearest(cells, others)
    speaks: NDArray[np.float32] = np.maximum(np.minimum(theirs, far) - np.minimum(ours, far), 0.0) / far
    return speaks


def _best(speaks: NDArray[np.float32], windows: NDArray[np.int32]) -> float:
    """Return the highest mean over a window."""
    total = np.pad(speaks, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    best = 0.0
    for rows, columns in windows.tolist():
        inside = total[rows:, columns:] - total[:-rows, columns:] - total[rows:, :-columns] + total[:-rows, :-columns]
        best = max(best, float(inside.max()) / (rows * columns))
    return min(best, 1.0)


def content_of_sights(sights: Mapping[str, Sight]) -> tuple[list[dict[str, Any]], dict[str, NDArray[Any]]]:
    """Return what a file says of the sights of goals, and the arrays in it."""
    said, arrays = [], dict[str, NDArray[Any]]()
    for number, (goal, one) in enumerate(sights.items()):
        said.append({"goal": goal, "far": one.far, "size": one.size})
        arrays |= {f"{name} {number}": getattr(one, name) for name in _ARRAYS}
    return said, arrays


def sights_of_content(said: list[dict[str, Any]], arrays: dict[str, NDArray[Any]]) -> dict[str, Sight]:
    """Take the sights of goals out of what a file says; LookupError, TypeError or ValueError where that is wrong."""
    return {
        str(one["goal"]): Sight(
            far=one["far"], size=one["size"], **{name: arrays.pop(f"{name} {number}") for name in _ARRAYS}
        )
        for number, one in enumerate(said)
    }


class Glimpse(NamedTuple):
    """How probable it is that what is sought is in view, and whether it is about as near as where the ways ended."""

    probability: float
    near: bool


class Witness:
    """Tells from view to view whether what is sought is in view."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self.reset()

    def reset(self) -> None:
        """Forget everything, for a new episode."""
        self._said = deque[float](maxlen=SETTINGS.views_as_one)

    def look(self, picture: Image) -> Glimpse:
        """Take a small picture. A view that is hidden is no evidence."""
        said, near = self._sight.says(picture), False
        if said is not None:
            self._said.append(said[0])
            # An area falls with the square of the distance.
            near = said[1] > self._sight.size / SETTINGS.as_near**2
        # Views of one moment are no independent witnesses: together they say what one says.
        mean = float(np.mean(self._said)) if self._said else 0.0
        odds = SETTINGS.in_view / (1.0 - SETTINGS.in_view) * math.exp(min(mean, 50.0))
        return Glimpse(odds / (1.0 + odds), near)


@dataclass(frozen=True, eq=False)
class Taught:
    """Keyframes of one drive as small pictures, and how long each is before its end, seconds of driving."""

    pictures: Sequence[Image]
    left_s: NDArray[np.float64]
    ends: bool
    """Whether it ends before what is sought."""


def learn_sight(drives: Sequence[Taught]) -> Sight | None:
    """Learn what some drives end before; None where nothing there stands out from their ways.

    Each drive's last `Settings.approach_s` are its approach, at most its last third; the rest is the way before.
    """
    way = [(d, k) for d, one in enumerate(drives) for k in range(len(one.pictures)) if k not in _approach(one)]
    way = [way[k] for k in evenly(len(way), SETTINGS.explaining)]
    if len(way) < 4:
        return None
    codes, of = _codes([drives[d].pictures[k] for d, k in way])
    pictures = [drives[d].pictures[k] for d, k in way]
    times = np.array([1e6 * d + drives[d].left_s[k] for d, k in way])
    beside = np.abs(times[:, None] - times[None, :]) < SETTINGS.beside_s

    def elsewhere(number: int) -> NDArray[np.bool_]:
        """Codes of the way that are not of the neighbourhood of one of its views."""
        return np.asarray(~beside[number][of])

    new = np.concatenate([nearest(cells_of(one, 2), codes[elsewhere(k)]).ravel() for k, one in enumerate(pictures)])
    new = new[np.isfinite(new)]
    if not new.size:
        return None
    stands_out, far = (float(one) for one in np.quantile(new, (SETTINGS.stands_out, SETTINGS.far)))
    followed = [list(_patches(one, codes, stands_out)) for one in drives if one.ends]
    ends = {id(one[0][0]) for one in followed if one}
    patches = [patch for one in followed for patch in one]
    patches = _lasting([patches[k] for k in evenly(len(patches), SETTINGS.explaining)])
    if not patches:
        return None
    others = np.concatenate([codes, *(_spread(cells[~mask], _BESIDE, codes) for _, cells, mask in patches)])
    sought = [cells[mask] for _, cells, mask in patches]
    sought = [one[evenly(len(one), _SOUGHT)] for one in sought]
    sizes = np.array([np.ptp(np.argwhere(mask), axis=0) + 2 for _, _, mask in patches]) // 2
    sizes = np.maximum(sizes, _LEAST)
    chosen = np.argsort(sizes.prod(axis=1))[evenly(len(sizes), SETTINGS.sizes)]
    windows = np.unique(sizes[chosen], axis=0).astype(np.int32)
    left_out = [
        _speaks(cells_of(one, 2), np.concatenate([*sought[:k], *sought[k + 1 :]]), others, far)
        for k, (one, _, _) in enumerate(patches)
        if len(patches) > 1
    ]
    here = [_best(one, windows) for one in left_out]
    at_end = [float(one.sum()) for one, (picture, _, _) in zip(left_out, patches, strict=False) if id(picture) in ends]
    every, new_codes = np.concatenate(sought), others[len(codes) :]
    elsewhere_scores = [
        _best(_speaks(cells_of(one, 2), every, np.concatenate([codes[elsewhere(k)], new_codes]), far), windows)
        for k, one in enumerate(pictures)
    ]
    ratio = _ratio(np.array(here), np.array(elsewhere_scores))
    if ratio is None:
        return None
    # Where none of the last views is left, it is never near.
    size = float(np.median(at_end)) if at_end else float(np.prod(SHAPE))
    return Sight(every.astype(np.float16), others.astype(np.float16), windows, far, ratio, size)


def _lasting(patches: list[Patch]) -> list[Patch]:
    """Return patches without the cells that look more like what is beside those of other views than like them.

    What stands before a door or a window may be in one piece with it in some views.
    """
    insides = [cells[mask] for _, cells, mask in patches]
    besides = [cells[::2, ::2][~mask[::2, ::2]] for _, cells, mask in patches]
    found = []
    for k, (picture, cells, mask) in enumerate(patches):
        if len(patches) > 1:
            inside, beside = (np.concatenate([*one[:k], *one[k + 1 :]]) for one in (insides, besides))
            lasts = mask.copy()
            lasts[mask] = nearest(cells[mask], inside) < nearest(cells[mask], beside)
            if lasts.sum() < _FEWEST:
                continue
            mask = lasts  # noqa: PLW2901 - what is left of it
        found.append((picture, cells, mask))
    return found


def _approach(one: Taught) -> range:
    count = len(one.pictures)
    if not one.ends:
        return range(count, count)
    within = int((one.left_s <= SETTINGS.approach_s).sum())
    return range(count - min(within, count // 3), count)


def _patches(one: Taught, codes: NDArray[np.float32], stands_out: float) -> Iterator[Patch]:
    """Yield the views that show what a drive ends before, the last first, their cells, and which of these are of it."""
    known = np.empty((0, _NUMBERS), dtype=np.float32)
    middle = np.array([np.nan, (SHAPE[1] - 1) / 2.0])
    for k in reversed(_approach(one)):
        cells = cells_of(one.pictures[k])
        new = nearest(cells, codes)
        if not len(known):
            mask = _piece(new > stands_out, new - stands_out, middle)
            if mask is None:
                return
        else:
            away = nearest(cells, known)
            mask = _piece(new > stands_out, np.maximum(new - away, 0.0), middle)
            # What stands out and is not like what has been followed so far is something else.
            if mask is None or (away[mask] > SETTINGS.like * new[mask]).mean() > 0.5:
                continue
        known = np.concatenate([known, cells[mask]])
        middle = np.argwhere(mask).mean(axis=0)
        yield one.pictures[k], cells, mask


def _piece(
    stands_out: NDArray[np.bool_], weights: NDArray[np.float32], middle: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Return the piece of a mask that weighs most, the nearer to a row and a column the more; None without any."""
    import cv2  # noqa: PLC0415 - see `smal.features.picture`

    count, labels, stats, middles = cv2.connectedComponentsWithStats(stands_out.astype(np.uint8))
    away = np.nan_to_num(middles[:, ::-1] - middle) / (SHAPE[1] / 4.0)
    sums = np.bincount(labels.ravel(), weights.ravel(), minlength=count) * np.exp(-0.5 * (away**2).sum(axis=1))
    sums[stats[:, cv2.CC_STAT_AREA] < _FEWEST] = 0.0
    sums[0] = 0.0
    return np.asarray(labels == sums.argmax()) if sums.max() > 0.0 else None


def _codes(pictures: Sequence[Image]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return cells that stand for all cells of some pictures, (n, 27), and of which picture each is, (n,)."""
    codes, of = np.empty((0, _NUMBERS), dtype=np.float32), []
    for number, picture in enumerate(pictures):
        taken = _spread(cells_of(picture, 2).reshape(-1, _NUMBERS), _CODES, codes)
        codes = np.concatenate([codes, taken])
        of += [number] * len(taken)
    return codes, np.array(of, dtype=np.intp)


def _spread(cells: NDArray[np.float32], most: int, codes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the cells that are furthest from codes and from each other, one after another (Gonzalez 1985)."""
    away, taken = nearest(cells, codes), []
    for _ in range(min(most, len(cells))):
        furthest = int(away.argmax())
        taken.append(cells[furthest])
        away = np.minimum(away, np.linalg.norm(cells - cells[furthest], axis=1))
    return np.array(taken, dtype=np.float32).reshape(-1, _NUMBERS)


def _ratio(here: NDArray[np.float64], elsewhere: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the log ratio at `SCORES`; None where what is sought does not stand out from the way.

    In view, a score is any share of one of the approach: light, side and what hides a part of it leave less of it, and
    nobody knows how much. Elsewhere scores are exponential; what so many let expect of the next one, whose mean is not
    known, is a Pareto distribution (Lomax).
    """
    if len(here) < 2:
        return None
    mean, count = max(float(elsewhere.mean()), SETTINGS.least_score * float(here.max())), len(elsewhere)
    shares = np.linspace(0.0, 1.0, 51)[1:]
    edges = np.append(SCORES, 1.0 + SCORES[1]) - SCORES[1] / 2.0
    p1 = np.histogram(np.multiply.outer(shares, here), edges)[0] / (shares.size * len(here))
    p0 = (1.0 + SCORES / (count * mean)) ** (-count - 1.0)
    ratio = log_ratio(p1, p0 / p0.sum())
    least = math.log(SETTINGS.false_seen * (1.0 - SETTINGS.in_view) / SETTINGS.in_view)
    tells = float(np.interp(here.max(), SCORES, ratio)) > least
    return np.clip(ratio, math.log(SETTINGS.hidden), 50.0) if tells else None
