"""Where taught drives share a place, and how the robot seen from one of them stands in the other.

The paper shares states between demonstrations where sequences of frames are alike (Algorithm 1); without that its graph
is a set of chains, on which no decision can be taken. We share places: two keyframes of different drives are one place
where each is the other's likeliest view, more alike than unrelated places, and so are their neighbours, in order, for
a whole correlation length. The virtual view that fits best tells how the one stands to the other.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smal.visual_map import TURNS_DEG, VIEWS_A_LENGTH, VisualMap

#: Keyframes whose views are compared at once, which bounds the memory.
_AT_ONCE = 32
#: Keyframes that one drive may go on by while the other goes on by one: drives stop, and turn elsewhere.
_ADVANCE = 3


def stitched(visual_map: VisualMap) -> VisualMap:
    """Return a map with the places that its drives share; none where there is one drive."""
    drives = visual_map.drives[visual_map.keyframes]
    found: list[tuple[int, int, tuple[float, float, float]]] = []
    names = np.unique(drives)
    if names.size > 1:
        best = _best_of_each_drive(visual_map, drives, names)
        for one in names:
            for other in names[names != one]:
                found.extend(_chained(visual_map, best, drives, int(one), int(other)))
    found.sort(key=lambda stitch: stitch[:2])
    return replace(
        visual_map,
        stitched=np.array([stitch[:2] for stitch in found], dtype=np.int32).reshape(-1, 2),
        stitch_offsets=np.array([stitch[2] for stitch in found], dtype=np.float64).reshape(-1, 3),
    )


@dataclass(frozen=True, eq=False)
class _Best:
    """For each keyframe and drive: the likeliest keyframe there (-1: none is likely), and how it stands to it."""

    keyframe: NDArray[np.intp]
    left: NDArray[np.float64]
    turned: NDArray[np.float64]


def _best_of_each_drive(visual_map: VisualMap, drives: NDArray[np.int32], names: NDArray[np.int32]) -> _Best:
    count, middle = len(drives), TURNS_DEG.size // 2
    keyframe = np.full((count, int(names.max()) + 1), -1, dtype=np.intp)
    left, turned = np.zeros(keyframe.shape), np.zeros(keyframe.shape)
    for first in range(0, count, _AT_ONCE):
        views = visual_map.views[first : first + _AT_ONCE, 1, middle]
        cosines = (visual_map.flat_views @ views.T).reshape(*visual_map.views.shape[:3], -1)
        for name in names:
            there = np.flatnonzero(drives == name)
            each = cosines[there].reshape(-1, views.shape[0])
            at = each.argmax(axis=0)
            k, p, t = np.unravel_index(at, (there.size, *visual_map.views.shape[1:3]))
            for row in range(views.shape[0]):
                if each[at[row], row] > visual_map.outlier_cosine:
                    grid = cosines[there[k[row]], :, :, row]
                    keyframe[first + row, name] = there[k[row]]
                    left[first + row, name] = (_peak(grid[:, t[row]], int(p[row])) - 1.0) * visual_map.aside
                    turn = _peak(grid[p[row]], int(t[row])) - middle
                    turned[first + row, name] = math.radians(turn * float(TURNS_DEG[1] - TURNS_DEG[0]))
    return _Best(keyframe, left, turned)


def _peak(values: NDArray[np.float32], at: int) -> float:
    """Return where the parabola through the largest value and its neighbours is highest."""
    middle = min(max(at, 1), values.size - 2)
    before, here, after = (float(values[middle + k]) for k in (-1, 0, 1))
    curve = before - 2.0 * here + after
    if curve >= 0.0:
        return float(at)
    return min(max(middle + 0.5 * (before - after) / curve, 0.0), values.size - 1.0)


def _chained(
    visual_map: VisualMap, best: _Best, drives: NDArray[np.int32], one: int, other: int
) -> list[tuple[int, int, tuple[float, float, float]]]:
    """Return the mutual pairs of two drives that go on in order for a correlation length."""
    here = np.flatnonzero(drives == one)
    there = best.keyframe[here, other]
    back = np.where(there >= 0, best.keyframe[np.maximum(there, 0), one], -1)
    mutual = (there >= 0) & (back >= 0) & (np.abs(back - here) <= _ADVANCE)
    goes_on = mutual[:-1] & mutual[1:] & (np.diff(there) >= 0) & (np.diff(there) <= _ADVANCE)
    breaks = np.flatnonzero(~goes_on) + 1
    runs = np.split(np.arange(here.size), breaks)
    kept = [k for run in runs if run.size > VIEWS_A_LENGTH for k in run]
    return [
        (int(here[k]), int(there[k]), (0.0, float(best.left[here[k], other]), float(best.turned[here[k], other])))
        for k in kept
    ]
