"""SeqSLAM, written from the paper: Milford & Wyeth, ICRA 2012.

Differences of small images are made comparable within each neighbourhood of references (local contrast enhancement),
and summed along straight lines: a query sequence is matched where the line of the smallest sum ends.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.trajectories import rolling, steps_back, sums_along

#: The paper's velocities, reference frames to one query frame.
VELOCITIES: Final = (0.8, 0.9, 1.0, 1.1, 1.2)
#: A standard deviation below this share of the mean difference is the rounding of float32 sums.
_NOISE: Final = 1e-5
#: References that stay in the processor's cache while they are compared.
_TILE: Final = 64


@dataclass(frozen=True)
class SeqSlamSettings:
    """The paper's parameters.

    Parameters
    ----------
    length : int
        Frames of a trajectory, d_s, at least 1.
    window : int
        R_window, at least 2: contrast is enhanced among the references up to half of it before and after, and the
        second best trajectory ends further away than half of it.
    """

    length: int = 10
    window: int = 10

    @property
    def half_window(self) -> int:
        """References on each side that belong to a neighbourhood."""
        return self.window // 2

    @property
    def offset(self) -> float:
        """Number c that makes every sum positive: of k numbers, none is over sqrt(k - 1) deviations off the mean."""
        return math.sqrt(2 * self.half_window + 1)

    def trajectories(self) -> list[list[int]]:
        """Return the different straight lines: references before the end, for 0 to length-1 queries before the end."""
        lines: list[list[int]] = np.unique(steps_back(VELOCITIES, self.length), axis=0).tolist()
        return lines


def match_seqslam(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    settings: SeqSlamSettings,
    progress: Progress = ignore,
) -> Matches:
    """Match each query with the end of the straight trajectory that differs least from it and its predecessors.

    With D the mean absolute differences, and mean and deviation over the references within R_window / 2 of i:

        D'(t, i) = (D(t, i) - mean) / deviation                      local contrast enhancement
        S(t, e) = min over V of 1/d_s sum_{k=0}^{d_s-1} D'(t - k, e - round(V k))
        e*(t) = argmin over e of S(t, e)                             the match
        score(t) = 1 - (S(t, e*) + c) / (S2(t) + c)                  the uniqueness

    where S2 is the least S of the ends further than R_window / 2 from e*. The paper compares the two by their ratio,
    which says nothing while sums may be negative or 0; with c (`SeqSlamSettings.offset`) every sum is positive.
    The paper's trajectories lie around a query; these end at it, so that a robot can use them.

    Parameters
    ----------
    references, queries : float32 arrays (n, m), (q, m)
        Patch-normalized thumbnails in order. A common factor does not matter.
    settings : SeqSlamSettings
    progress : callable
        Called with the number of queries that are done.

    Returns
    -------
    Matches
        None for the first d_s - 1 queries, nor for any where n is below d_s or no trajectory fits into n. Scores are
        in [0, 1). Where all of the trajectories end within the window, the second best is taken to be S2 = 0: what
        references without any contrast have. Of equal trajectories the earliest.

    Raises
    ------
    ValueError
        The features do not fit each other or are not finite.
    """
    check_features(references, queries)
    (total, count), length = (len(queries), len(references)), settings.length
    matches = Matches.none(total)
    lines = [line for line in settings.trajectories() if line[-1] < count]
    if count < length or not lines:
        progress(total)
        return matches

    def contrast(frames: slice) -> NDArray[np.float32]:
        return enhanced(differences(references, queries[frames]), settings.half_window)

    for done, rows in rolling(contrast, total, count, length):
        costs = np.full((len(rows) - length + 1, count), np.inf, dtype=np.float32)
        for line in lines:
            fitting = costs[:, line[-1] :]
            np.minimum(fitting, sums_along(rows, line), out=fitting)
        ends = slice(done - len(costs), done)
        costs = costs / np.float32(length) + np.float32(settings.offset)
        matches.reference[ends], matches.score[ends] = _most_unique(costs, settings)
        progress(done)
    progress(total)
    return matches


def differences(references: NDArray[np.float32], queries: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean absolute difference of each query (q, m) and reference (n, m), float32 (q, n)."""
    result = np.empty((len(queries), len(references)), dtype=np.float32)
    for start in range(0, len(references), _TILE):
        tile = references[start : start + _TILE]
        for row, query in zip(result, queries, strict=True):
            row[start : start + _TILE] = np.abs(tile - query).mean(axis=1)
    return result


def enhanced(rows: NDArray[np.float32], half_window: int) -> NDArray[np.float32]:
    """Enhance the local contrast of differences (q, n): deviations from the mean of the references around each.

    The window of reference i is i - half_window..i + half_window, cut off at the ends of the traverse; the deviation
    is that of the whole population. Where all differences of a window are the same there is no contrast: 0.
    """
    places = np.arange(rows.shape[1])
    first, last = np.maximum(places - half_window, 0), np.minimum(places + half_window + 1, places.size)

    def around(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sums = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
        means: NDArray[np.float64] = (sums[:, last] - sums[:, first]) / (last - first)
        return means

    level = rows.mean(axis=1, keepdims=True, dtype=np.float64)
    above = rows - level
    mean = around(above)
    deviation = np.sqrt(np.maximum(around(above**2) - mean**2, 0.0))
    contrast = np.zeros(rows.shape)
    np.divide(above - mean, deviation, out=contrast, where=deviation > _NOISE * (level + mean))
    return contrast.astype(np.float32)


def _most_unique(
    costs: NDArray[np.float32], settings: SeqSlamSettings
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the reference of least cost for each query (c,), and how unique it is.

    `costs` (c, n) are positive, and infinite where no trajectory ends; they are written over.
    """
    queries = np.arange(len(costs))
    best = costs.argmin(axis=1)
    first = costs[queries, best].astype(np.float64)
    near = best[:, None] + np.arange(-settings.half_window, settings.half_window + 1)
    np.put_along_axis(costs, np.clip(near, 0, costs.shape[1] - 1), np.inf, axis=1)
    second = costs.min(axis=1).astype(np.float64)
    second = np.where(np.isfinite(second), second, settings.offset)
    return best, 1.0 - np.minimum(first / second, 1.0)
