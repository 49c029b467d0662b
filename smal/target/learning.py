"""Learning of the target from the ends of drives, and of its difference from all other views.

A drive ends before the target. The target consists of the cells in the last views that the way
before does not explain, in one piece, ahead. It is tracked back from the last view over the approach,
so that it is learned at several sizes. Views of the approach, each left out of the target, calibrate
views with the target; views of the way, each left out with its neighbourhood, views without it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.arrays import Bools, Float32s, Floats, Int32s, evenly
from smal.camera import Image
from smal.features.cells import NUMBERS, cells_of, nearest
from smal.features.detectors import Detection
from smal.features.extraction import in_parallel
from smal.features.resizing import SHAPE
from smal.target.appearance import (
    SIZES,
    TARGET_CONFIG,
    Compared,
    TargetAppearance,
    Window,
    lower_quantile,
)
from smal.target.distance import Distance
from smal.target.evidence import ScoreEvidence
from smal.target.label import TargetLabel, area, best

#: Left, top, right, bottom: shares of a view's width and height.
Box = tuple[float, float, float, float]
_VIEWS: Final = 60  # Views of the way, and of the approach, whose cells are kept.
#: Cells kept of each view: of the way, beside the target, of the target.
_CODES: Final = 32
_BESIDE: Final = 128
_TARGET: Final = 24
_FEWEST: Final = 8  # Minimum cells of a target.
_LEAST: Final = 3  # Minimum rows and columns of a window: fewer cells look like anything.


@dataclass(frozen=True, eq=False)
class Taught:
    """Keyframes of one drive as small pictures, and the time of driving from each to the end, seconds."""

    pictures: Sequence[Image]
    left_s: Floats
    ends: bool  # Whether it ends before the target.
    box: Box | None = None  # Box of the target in its last view, if an operator has drawn it.
    #: Detections in each keyframe; empty without detectors.
    detected: Sequence[Sequence[Detection]] = ()

    def approach(self) -> range:
        """Return the views of the approach: the last seconds, at most the last third."""
        count = len(self.pictures)
        within = int((self.left_s <= TARGET_CONFIG.approach_s).sum()) if self.ends else 0
        return range(count - min(within, count // 3), count)


class _Patch(NamedTuple):
    """The target in one view of the approach."""

    cells: Float32s  # Cells of the small picture, (60, 80, 27).
    mask: Bools  # Cells of the target.
    left_s: float

    def inside(self) -> Float32s:
        """Return an even selection of the target's cells, (n, 27)."""
        cells = self.cells[self.mask]
        return cells[evenly(len(cells), _TARGET)]


class _Way:
    """Views of the way before the approach, and some of their cells."""

    def __init__(self, drives: Sequence[Taught]) -> None:
        views = [(d, k) for d, one in enumerate(drives) for k in range(one.approach().start)]
        views = [views[k] for k in evenly(len(views), _VIEWS)]
        self.cells = [cells_of(drives[d].pictures[k], 2) for d, k in views]
        self.codes = np.empty((0, NUMBERS), dtype=np.float32)
        for cells in self.cells:
            self.codes = np.concatenate([self.codes, _spread(cells, _CODES, self.codes)])
        # Just before the approach, the target can already be in view.
        first_s = TARGET_CONFIG.approach_s + TARGET_CONFIG.beside_s
        without = [n for n, (d, k) in enumerate(views) if drives[d].left_s[k] >= first_s]
        self._without = without or range(len(views))
        # Two drives are never at the same place at the same time.
        times = np.array([1e6 * d + drives[d].left_s[k] for d, k in views])
        self._apart = np.abs(times[:, None] - times) >= TARGET_CONFIG.beside_s
        counts = [min(_CODES, cells.shape[0] * cells.shape[1]) for cells in self.cells]
        self._view = np.repeat(np.arange(len(views)), counts)

    def elsewhere(self, number: int) -> Float32s:
        """Return the codes outside the neighbourhood of a view."""
        return np.asarray(self.codes[self._apart[number][self._view]])

    def compared(self, target: Float32s, beside: Float32s) -> list[Compared]:
        """Compare views without the target with it and with all other views but their neighbourhood."""

        def compare(number: int) -> Compared:
            others = np.concatenate([self.elsewhere(number), beside])
            return Compared.of(self.cells[number], target, others)

        return list(in_parallel(compare, self._without))

    def threshold(self) -> float:
        """Return the distance from the rest of the way beyond which a cell is new."""
        numbers = range(len(self.cells))
        apart = in_parallel(lambda k: nearest(self.cells[k], self.elsewhere(k)), numbers)
        distances = np.concatenate([each.ravel() for each in apart])
        return lower_quantile(distances, TARGET_CONFIG.known)


def learn_appearance(drives: Sequence[Taught]) -> TargetAppearance | None:
    """Learn the target at the ends of some drives; None if nothing there stands out from their ways."""
    way = _Way(drives)
    patches = _tracked(drives, way) if len(way.cells) >= 4 else []
    if len(patches) < 2:
        return None
    parts = [patch.inside() for patch in patches]
    beside = np.concatenate([_spread(p.cells[~p.mask], _BESIDE, way.codes) for p in patches])
    target = np.concatenate(parts)
    others = np.concatenate([way.codes, beside])
    windows = _windows(patches)
    elsewhere = way.compared(target, beside)
    here = [
        Compared.of(patch.cells[::2, ::2], _without(parts, k), others)
        for k, patch in enumerate(patches)
    ]
    found = [each.window(windows) for each in here]
    scores = [window.score for window in found]
    usual = [each.window(windows).score for each in elsewhere]
    evidence = ScoreEvidence.fit(scores, usual, TARGET_CONFIG.sure)
    if evidence is None:
        return None
    distance = _distance(patches, here, found, evidence)
    unlike = max(each.unlike for each in elsewhere)
    codes = target.astype(np.float16), others.astype(np.float16)
    return TargetAppearance(*codes, windows, unlike, evidence, distance)


def _distance(
    patches: Sequence[_Patch],
    here: Sequence[Compared],
    found: Sequence[Window],
    evidence: ScoreEvidence,
) -> Distance:
    """Calibrate the distance on the views of the approach in which the target is whole."""
    # Further away the target has hardly a cell.
    clear = [
        (patch.left_s, each.extent(window, evidence.usual))
        for patch, each, window in zip(patches, here, found, strict=True)
        if window.score > evidence.most
    ]
    whole = [(left_s, extent) for left_s, extent in clear if not extent.cut] or clear
    left_s, sizes, lows = np.array([(left_s, one.size, one.low) for left_s, one in whole]).T
    return Distance.fit(left_s, sizes, lows, TARGET_CONFIG.end_s)


def _tracked(drives: Sequence[Taught], way: _Way) -> list[_Patch]:
    """Return the target in the views of all approaches."""
    threshold = way.threshold()
    if not np.isfinite(threshold):
        return []
    each = in_parallel(lambda one: list(_patches(one, way.codes, threshold)), drives)
    patches = [patch for of_drive in each for patch in of_drive]
    return _lasting([patches[k] for k in evenly(len(patches), _VIEWS)])


def learn_label(drives: Sequence[Taught]) -> TargetLabel | None:
    """Learn the label that detectors find at the ends of drives and not on their ways; None without any.

    Of several labels, the last views decide, in the drawn box if any; then the size.
    """
    last = [found for one in drives for found in _last_detections(one)]
    labels = [
        _calibrated(label, evidence, [found for found in last if found.label == label])
        for label in sorted({found.label for found in last})
        if (evidence := _evidence_of(label, drives)) is not None
    ]
    return max(labels, key=lambda each: each[:2])[2] if labels else None


def _calibrated(
    label: str, evidence: ScoreEvidence, last: Sequence[Detection]
) -> tuple[float, float, TargetLabel]:
    """Return the evidence of the last detections of a label, their largest size, and the label."""
    total = float(np.sum([evidence.log_ratio(found.score) for found in last]))
    size = max(area(found) for found in last)
    return total, size, TargetLabel(label, size, evidence)


def _evidence_of(label: str, drives: Sequence[Taught]) -> ScoreEvidence | None:
    """Calibrate the scores of a label."""
    here: list[float] = []
    elsewhere: list[float] = []
    for one in drives:
        scores = [best(view, label)[0] for view in one.detected]
        here += scores[one.approach().start :]
        elsewhere += scores[: _first_view(one, scores)]
    return ScoreEvidence.fit(here, elsewhere, TARGET_CONFIG.sure)


def _last_detections(one: Taught) -> Iterator[Detection]:
    """Yield the detections at the end of a drive, in its box if any."""
    for k in one.approach():
        if one.left_s[k] <= TARGET_CONFIG.moment_s:
            for found in one.detected[k]:
                if area(found) > 0.0 and (one.box is None or _middle_in(found, one.box)):
                    yield found


def _first_view(one: Taught, scores: Sequence[float]) -> int:
    """Return the first view with a detection, across short gaps: on a straight way a tag can be read from far away."""
    first = one.approach().start
    least = float(np.mean(scores[first:] or [0.0])) / 2.0
    for k in reversed(range(first)):
        if scores[k] >= least:
            first = k
        elif one.left_s[k] - one.left_s[first] > TARGET_CONFIG.beside_s:
            break
    return first


def _middle_in(found: Detection, box: Box) -> bool:
    middle = (found.box[0] + found.box[2]) / 2.0, (found.box[1] + found.box[3]) / 2.0
    return box[0] <= middle[0] <= box[2] and box[1] <= middle[1] <= box[3]


def _without(parts: Sequence[Float32s], number: int) -> Float32s:
    return np.concatenate([*parts[:number], *parts[number + 1 :]])


def _windows(patches: Sequence[_Patch]) -> Int32s:
    """Return sizes of windows: those of the target over the approach, in cells of every second row and column."""
    sizes = np.array([np.ptp(np.argwhere(patch.mask), axis=0) + 2 for patch in patches]) // 2
    sizes = np.maximum(sizes, _LEAST)
    chosen = np.argsort(sizes.prod(axis=1))[evenly(len(sizes), SIZES)]
    return np.unique(sizes[chosen], axis=0).astype(np.int32)


def _lasting(patches: list[_Patch]) -> list[_Patch]:
    """Return patches without the cells that are more like the background of other views than like the target.

    In some views, the target can be in one piece with the object behind it.
    """
    if len(patches) < 2:
        return patches
    insides = [patch.cells[patch.mask] for patch in patches]
    besides = [patch.cells[::2, ::2][~patch.mask[::2, ::2]] for patch in patches]
    found = []
    for k, patch in enumerate(patches):
        inside = nearest(insides[k], _without(insides, k))
        lasts = patch.mask.copy()
        lasts[patch.mask] = inside < nearest(insides[k], _without(besides, k))
        if lasts.sum() >= _FEWEST:
            found.append(patch._replace(mask=lasts))
    return found


def _patches(one: Taught, codes: Float32s, threshold: float) -> Iterator[_Patch]:
    """Yield the target in the views of the approach, the last view first.

    A cell is new from a threshold of its distance from the codes of the way on.
    """
    known = np.empty((0, NUMBERS), dtype=np.float32)
    middle = np.array([np.nan, (SHAPE[1] - 1) / 2.0])
    for k in reversed(one.approach()):
        cells = cells_of(one.pictures[k])
        new = nearest(cells, codes)
        above = new > threshold
        if not len(known):
            mask = _first_mask(one.box, above, new - threshold, middle)
            if mask is None:
                return
        else:
            away = nearest(cells, known)
            alike = away < new
            # Beside a drawn target, other new things can be in one piece with it.
            above &= alike | (one.box is None)
            mask = _piece(above, np.maximum(new - away, 0.0), middle)
            if mask is None or alike[mask].mean() < 0.5:
                continue
        known = np.concatenate([known, cells[mask]])
        middle = np.argwhere(mask).mean(axis=0)
        yield _Patch(cells, mask, float(one.left_s[k]))


def _first_mask(box: Box | None, above: Bools, weights: Float32s, middle: Floats) -> Bools | None:
    """Return the target in the last view: in the drawn box, or the most central new piece."""
    return _piece(above, weights, middle) if box is None else _drawn(box, above)


def _drawn(box: Box, new: Bools) -> Bools:
    """Return the new cells in a box, or all of its cells if hardly any is new."""
    inside = np.zeros(new.shape, dtype=np.bool_)
    left, top, right, bottom = (round(share * SHAPE[(k + 1) % 2]) for k, share in enumerate(box))
    inside[top:bottom, left:right] = True
    return inside & new if (inside & new).sum() >= _FEWEST else inside


def _piece(mask: Bools, weights: Float32s, middle: Floats) -> Bools | None:
    """Return the heaviest connected component of a mask, with more weight near a row and a column; None if empty."""
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    count, labels, stats, middles = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    away = np.nan_to_num(middles[:, ::-1] - middle) / (SHAPE[1] / 4.0)
    central = np.exp(-0.5 * (away**2).sum(axis=1))
    sums = np.bincount(labels.ravel(), weights.ravel(), minlength=count) * central
    sums[stats[:, cv2.CC_STAT_AREA] < _FEWEST] = 0.0
    sums[0] = 0.0
    return np.asarray(labels == sums.argmax()) if sums.max() > 0.0 else None


def _spread(cells: Float32s, most: int, codes: Float32s) -> Float32s:
    """Return the cells furthest from codes and from each other, in turn (Gonzalez 1985)."""
    flat = cells.reshape(-1, NUMBERS)
    away = nearest(flat, codes)
    taken: list[NDArray[np.float32]] = []
    for _ in range(min(most, len(flat))):
        furthest = int(away.argmax())
        taken.append(flat[furthest])
        away = np.minimum(away, np.linalg.norm(flat - flat[furthest], axis=1))
    return np.array(taken, dtype=np.float32).reshape(-1, NUMBERS)
