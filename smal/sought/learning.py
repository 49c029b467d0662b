"""Learning of the target from the ends of drives, and of its difference from all other views.

A drive ends before the target. The target consists of the cells in the last views that the way before does not explain:
cells of a small picture that are further from all cells of the way than nearly any cell of the way is from the rest, in
one piece, ahead. It is tracked back from the last view over the approach, so that it is learned at several sizes.

Scores of the approach, each view left out of the target, calibrate views with the target. Scores of the way, each
view's neighbourhood left out, calibrate views without it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.camera import Image
from smal.features.detectors import Detection
from smal.features.extraction import in_parallel
from smal.features.resizing import SHAPE
from smal.keyframes import MAP_CONFIG
from smal.likelihood import evenly, log_ratio
from smal.sought.score import SCORES
from smal.sought.sight import (
    NUMBERS,
    TARGET_CONFIG,
    Sight,
    best_window,
    cells_of,
    nearest,
    speaking,
)
from smal.sought.word import Word, area, best

#: Cells kept of each view: of the way, of what stands beside what is sought, of what is sought.
_CODES = 32
_BESIDE = 128
_SOUGHT = 24
Box = tuple[
    float, float, float, float
]  # Left, top, right, bottom: shares of a view's width and height.
_FEWEST: Final = 8  # Cells that are the least to be looked for.
_LEAST: Final = 3  # Rows and columns that a window has at least: fewer cells look like anything.


class _Patch(NamedTuple):
    """The target in one view of the approach."""

    cells: NDArray[np.float32]  # Cells of the small picture, (60, 80, 27).
    mask: NDArray[np.bool_]  # Which of these are of what is sought.
    last: bool  # Whether it is the drive's last view.


@dataclass(frozen=True, eq=False)
class Taught:
    """Keyframes of one drive as small pictures, and the time of driving from each to the end, seconds."""

    pictures: Sequence[Image]
    left_s: NDArray[np.float64]
    ends: bool  # Whether it ends before what is sought.
    box: Box | None = None  # Where that is in its last view, if somebody has drawn it.
    detected: Sequence[
        Sequence[Detection]
    ] = ()  # What detectors find in each keyframe; nothing without any.


def learn_sight(drives: Sequence[Taught]) -> Sight | None:  # complexipy: ignore
    """Learn the target at the ends of some drives; None if nothing there stands out from their ways.

    The approach is each drive's last `TargetConfig.approach_s`, at most its last third; the rest is the way.
    """
    way = [
        (d, k)
        for d, one in enumerate(drives)
        for k in range(len(one.pictures))
        if k not in _approach(one)
    ]
    way = [way[k] for k in evenly(len(way), TARGET_CONFIG.explaining)]
    if len(way) < 4:
        return None
    codes, of = _codes([drives[d].pictures[k] for d, k in way])
    pictures = [drives[d].pictures[k] for d, k in way]
    times = np.array([1e6 * d + drives[d].left_s[k] for d, k in way])
    beside = np.abs(times[:, None] - times[None, :]) < TARGET_CONFIG.beside_s

    def elsewhere(number: int) -> NDArray[np.bool_]:
        """Return the codes of the way outside the neighbourhood of a view."""
        return np.asarray(~beside[number][of])

    unlike = in_parallel(
        lambda k: nearest(cells_of(pictures[k], 2), codes[elsewhere(k)]), range(len(pictures))
    )
    new = np.concatenate([one.ravel() for one in unlike])
    new = new[np.isfinite(new)]
    if not new.size:
        return None
    stands_out, far = (
        float(one) for one in np.quantile(new, (TARGET_CONFIG.stands_out, TARGET_CONFIG.far))
    )
    each = in_parallel(
        lambda one: list(_patches(one, codes, stands_out)), [one for one in drives if one.ends]
    )
    patches = [patch for some in each for patch in some]
    patches = _lasting([patches[k] for k in evenly(len(patches), TARGET_CONFIG.explaining)])
    if not patches:
        return None
    others = np.concatenate(
        [codes, *(_spread(cells[~mask], _BESIDE, codes) for cells, mask, _ in patches)]
    )
    sought = [cells[mask] for cells, mask, _ in patches]
    sought = [one[evenly(len(one), _SOUGHT)] for one in sought]
    sizes = np.array([np.ptp(np.argwhere(mask), axis=0) + 2 for _, mask, _ in patches]) // 2
    sizes = np.maximum(sizes, _LEAST)
    chosen = np.argsort(sizes.prod(axis=1))[evenly(len(sizes), TARGET_CONFIG.sizes)]
    windows = np.unique(sizes[chosen], axis=0).astype(np.int32)
    rest = [
        np.concatenate([*sought[:k], *sought[k + 1 :]])
        for k in range(len(sought))
        if len(sought) > 1
    ]
    without_it = zip(patches, rest, strict=False)
    left_out = list(
        in_parallel(lambda one: speaking(one[0].cells[::2, ::2], one[1], others, far), without_it)
    )
    found = [best_window(one, windows) for one in left_out]
    every = np.concatenate(sought)
    added = others[len(codes) :]

    def score_elsewhere(k: int) -> float:
        known = np.concatenate([codes[elsewhere(k)], added])
        return best_window(speaking(cells_of(pictures[k], 2), every, known, far), windows).score

    elsewhere_scores = list(in_parallel(score_elsewhere, range(len(pictures))))
    ratio = _ratio(np.array([one.score for one in found]), np.array(elsewhere_scores))
    if ratio is None:
        return None
    sums = np.array([float(one.sum()) for one in left_out])
    lows = np.array([one.low for one in found])
    # Where none of the last views is left, the nearest one is that in which it is largest.
    at_end = [k for k, patch in enumerate(patches) if patch.last] or [int(sums.argmax())]
    size = float(np.median(sums[at_end]))
    low = float(np.median(lows[at_end]))
    # A level camera sees what looks half as large half as far from the middle; another one, or another thing, may not.
    large = np.sqrt(sums / (size or 1.0))
    far_off = lows / (low or 1.0)
    small = (large > 0.0) & (large < 0.5)
    if (
        abs(low) < TARGET_CONFIG.low
        or not small.any()
        or not 0.0 < far_off[small].mean() < 1.5 * large[small].mean()
    ):
        low = 0.0
    codes_of = every.astype(np.float16), others.astype(np.float16)
    return Sight(*codes_of, windows, far, ratio, size, low) if size > 0.0 else None


def learn_word(drives: Sequence[Taught]) -> Word | None:  # complexipy: ignore
    """Learn the label that detectors find at the ends of drives and not on their ways; None without any.

    Of several labels, the last views decide, in the drawn box if any; then the size.
    """
    last = [
        [
            found
            for k in _approach(one)
            if one.left_s[k] <= TARGET_CONFIG.same_moment_s
            for found in one.detected[k]
            if area(found) > 0.0 and (one.box is None or _middle_in(found, one.box))
        ]
        for one in drives
    ]
    words: list[tuple[float, Word]] = []
    for label in sorted({found.label for each in last for found in each}):
        scores = [np.array([best(view, label)[0] for view in one.detected]) for one in drives]
        here = np.concatenate(
            [each[_approach(one)] for one, each in zip(drives, scores, strict=True)]
        )
        shows = [
            _shows(one, each, here.mean() / 2.0) for one, each in zip(drives, scores, strict=True)
        ]
        elsewhere = np.concatenate(
            [each[:first] for first, each in zip(shows, scores, strict=True)]
        )
        ratio = _ratio(here, elsewhere) if elsewhere.size else None
        if ratio is not None:
            of_it = [[found for found in each if found.label == label] for each in last]
            told = sum(
                float(np.interp(found.score, SCORES, ratio)) for each in of_it for found in each
            )
            size = float(np.median([area(each[-1]) for each in of_it if each]))
            words.append((told, Word(label, size, ratio)))
    return max(words, key=lambda each: (each[0], each[1].size))[1] if words else None


def _shows(one: Taught, scores: NDArray[np.float64], least: float) -> int:
    """Return the first view with a detection, across short gaps: on a straight way a tag can be read from far away."""
    first = _approach(one).start
    for k in reversed(range(first)):
        if scores[k] >= least:
            first = k
        elif one.left_s[k] - one.left_s[first] > TARGET_CONFIG.beside_s:
            break
    return first


def _middle_in(found: Detection, box: Box) -> bool:
    middle = (found.box[0] + found.box[2]) / 2.0, (found.box[1] + found.box[3]) / 2.0
    return box[0] <= middle[0] <= box[2] and box[1] <= middle[1] <= box[3]


def _lasting(patches: list[_Patch]) -> list[_Patch]:
    """Return patches without the cells that are more like the background of other views than like the target.

    In some views, the target can be in one piece with the object behind it.
    """
    insides = [cells[mask] for cells, mask, _ in patches]
    besides = [cells[::2, ::2][~mask[::2, ::2]] for cells, mask, _ in patches]
    found = []
    for k, (cells, mask, last) in enumerate(patches):
        if len(patches) > 1:
            inside, beside = (
                np.concatenate([*one[:k], *one[k + 1 :]]) for one in (insides, besides)
            )
            lasts = mask.copy()
            lasts[mask] = nearest(cells[mask], inside) < nearest(cells[mask], beside)
            if lasts.sum() < _FEWEST:
                continue
            mask = lasts  # noqa: PLW2901 - what is left of it
        found.append(_Patch(cells, mask, last))
    return found


def _approach(one: Taught) -> range:
    count = len(one.pictures)
    if not one.ends:
        return range(count, count)
    within = int((one.left_s <= TARGET_CONFIG.approach_s).sum())
    return range(count - min(within, count // 3), count)


def _patches(one: Taught, codes: NDArray[np.float32], stands_out: float) -> Iterator[_Patch]:
    """Yield the views of the approach with the target, the last first, with their cells and the mask of the target."""
    known = np.empty((0, NUMBERS), dtype=np.float32)
    middle = np.array([np.nan, (SHAPE[1] - 1) / 2.0])
    for k in reversed(_approach(one)):
        cells = cells_of(one.pictures[k])
        new = nearest(cells, codes)
        if not len(known):
            new_here = new > stands_out
            mask = (
                _piece(new_here, new - stands_out, middle)
                if one.box is None
                else _drawn(one.box, new_here)
            )
            if mask is None:
                return
        else:
            away = nearest(cells, known)
            # Where it is drawn, what stands beside it is not of it, whatever piece it makes with it.
            of_it = (new > stands_out) & ((one.box is None) | (away <= TARGET_CONFIG.like * new))
            mask = _piece(of_it, np.maximum(new - away, 0.0), middle)
            # What stands out and is not like what has been followed so far is something else.
            if mask is None or (away[mask] > TARGET_CONFIG.like * new[mask]).mean() > 0.5:
                continue
        known = np.concatenate([known, cells[mask]])
        middle = np.argwhere(mask).mean(axis=0)
        yield _Patch(cells, mask, last=k == len(one.pictures) - 1)


def _drawn(box: Box, stands_out: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells in a box that stand out, or all of them if hardly any does."""
    inside = np.zeros(stands_out.shape, dtype=np.bool_)
    left, top, right, bottom = (round(share * SHAPE[(k + 1) % 2]) for k, share in enumerate(box))
    inside[top:bottom, left:right] = True
    return inside & stands_out if (inside & stands_out).sum() >= _FEWEST else inside


def _piece(
    stands_out: NDArray[np.bool_], weights: NDArray[np.float32], middle: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Return the heaviest connected component of a mask, with more weight near a row and a column; None if empty."""
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    count, labels, stats, middles = cv2.connectedComponentsWithStats(stands_out.astype(np.uint8))
    away = np.nan_to_num(middles[:, ::-1] - middle) / (SHAPE[1] / 4.0)
    sums = np.bincount(labels.ravel(), weights.ravel(), minlength=count) * np.exp(
        -0.5 * (away**2).sum(axis=1)
    )
    sums[stats[:, cv2.CC_STAT_AREA] < _FEWEST] = 0.0
    sums[0] = 0.0
    return np.asarray(labels == sums.argmax()) if sums.max() > 0.0 else None


def _codes(pictures: Sequence[Image]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return representative cells of some pictures, (n, 27), and the picture of each, (n,)."""
    codes = np.empty((0, NUMBERS), dtype=np.float32)
    of = []
    for number, picture in enumerate(pictures):
        taken = _spread(cells_of(picture, 2).reshape(-1, NUMBERS), _CODES, codes)
        codes = np.concatenate([codes, taken])
        of += [number] * len(taken)
    return codes, np.array(of, dtype=np.intp)


def _spread(
    cells: NDArray[np.float32], most: int, codes: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the cells furthest from codes and from each other, in turn (Gonzalez 1985)."""
    away = nearest(cells, codes)
    taken = []
    for _ in range(min(most, len(cells))):
        furthest = int(away.argmax())
        taken.append(cells[furthest])
        away = np.minimum(away, np.linalg.norm(cells - cells[furthest], axis=1))
    return np.array(taken, dtype=np.float32).reshape(-1, NUMBERS)


def _ratio(here: NDArray[np.float64], elsewhere: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the log ratio at `SCORES`; None if the target does not stand out from the way.

    In view, a score is an unknown share of a score of the approach: light, viewpoint and occlusion reduce it.
    Elsewhere scores are exponential. The predictive distribution of the next of n such scores, with an unknown mean,
    is a Pareto distribution (Lomax).
    """
    if len(here) < 2:
        return None
    mean = max(float(elsewhere.mean()), TARGET_CONFIG.least_score * float(here.max()))
    count = len(elsewhere)
    shares = np.linspace(0.0, 1.0, 51)[1:]
    edges = np.append(SCORES, 1.0 + SCORES[1]) - SCORES[1] / 2.0
    p1 = np.histogram(np.multiply.outer(shares, here), edges)[0] / (shares.size * len(here))
    p0 = (1.0 + SCORES / (count * mean)) ** (-count - 1.0)
    ratio = log_ratio(p1, p0 / p0.sum())
    least = math.log(
        TARGET_CONFIG.false_seen * (1.0 - TARGET_CONFIG.in_view) / TARGET_CONFIG.in_view
    )
    tells = float(np.interp(here.max(), SCORES, ratio)) > least
    return np.clip(ratio, math.log(MAP_CONFIG.hidden), 50.0) if tells else None
