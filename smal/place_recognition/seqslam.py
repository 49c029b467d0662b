"""SeqSLAM, written from the paper: Milford & Wyeth, ICRA 2012.

Differences of small images are made comparable within each neighbourhood of references (local contrast enhancement),
and summed along straight lines: a query sequence is matched where the line of the smallest sum ends.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smal.paper.compiled import compiled
from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.trajectories import rolling, steps_back, sums_along

_MOST_VELOCITIES = 1000
#: A standard deviation below this share of the mean difference is the rounding of float32 sums.
_NOISE = 1e-5
#: References that stay in the processor's cache while all queries of a block pass.
_TILE = 16


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
    v_min, v_max, v_step : float
        Velocities that are tried, in reference frames per query frame: from v_min to v_max, 0 < v_min <= v_max,
        in steps of v_step > 0.

    Raises
    ------
    ValueError
        A number is out of its range, or there are more than 1000 velocities.
    """

    length: int = 10
    window: int = 10
    v_min: float = 0.8
    v_max: float = 1.2
    v_step: float = 0.1

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"a SeqSLAM trajectory needs a length of at least 1, got {self.length}")
        if self.window < 2:
            raise ValueError(f"SeqSLAM needs a window of at least 2, got {self.window}")
        if not 0.0 < self.v_min <= self.v_max < math.inf:
            raise ValueError(f"SeqSLAM needs velocities 0 < v_min <= v_max, got {self.v_min} and {self.v_max}")
        if not self.v_step > 0.0:
            raise ValueError(f"SeqSLAM needs a velocity step above 0, got {self.v_step}")
        if (self.v_max - self.v_min) / self.v_step >= _MOST_VELOCITIES:
            raise ValueError(f"SeqSLAM tries at most {_MOST_VELOCITIES} velocities: v_step {self.v_step} is too small")

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
        # Without the small addition 0.8 + 4 * 0.1 would lie beyond 1.2.
        count = math.floor((self.v_max - self.v_min) / self.v_step + 1e-9) + 1
        velocities = self.v_min + self.v_step * np.arange(count)
        lines: list[list[int]] = np.unique(steps_back(velocities, self.length), axis=0).tolist()
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
    which says nothing while sums may be negative or 0; with c = sqrt(2 floor(R_window / 2) + 1), the root of how many
    references a neighbourhood has, every sum is positive whatever the data. The score grows with the ratio of S2 to
    S and is 0 where the second best is as good as the best.

    The paper's trajectories lie around a query; these end at it, so that a robot can use them.

    Parameters
    ----------
    references : float32 array (n, m)
        Patch-normalized thumbnails in order. A common factor does not matter.
    queries : float32 array (q, m)
        Likewise.
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
    matches = Matches.none(queries.shape[0])
    count = references.shape[0]
    lines = [line for line in settings.trajectories() if line[-1] < count]
    if count < settings.length or not lines:
        progress(queries.shape[0])
        return matches
    templates = np.ascontiguousarray(references, dtype=np.float32)

    def contrast(frames: slice) -> NDArray[np.float32]:
        block = np.ascontiguousarray(queries[frames], dtype=np.float32)
        return enhanced(differences(templates, block), settings.half_window)

    for done, rows in rolling(contrast, queries.shape[0], count, settings.length):
        costs = _best_sums(rows, lines) / np.float32(settings.length) + np.float32(settings.offset)
        best, score = _most_unique(costs, settings)
        ends = slice(done - best.size, done)
        matches.reference[ends], matches.score[ends] = best, score
        progress(done)
    progress(queries.shape[0])
    return matches


def differences(references: NDArray[np.float32], queries: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean absolute difference of each query (q, m) and reference (n, m), float32 (q, n), C order all."""
    # Of 1000 and 1000 thumbnails of 2048 numbers this takes 0.07 s, scipy's cdist 0.66 s.
    result = np.empty((queries.shape[0], references.shape[0]), dtype=np.float32)
    _differences(references, queries, result)
    return result


@compiled
def _differences(references: NDArray[np.float32], queries: NDArray[np.float32], result: NDArray[np.float32]) -> None:
    count, size = references.shape
    for start in range(0, count, _TILE):
        end = min(count, start + _TILE)
        for i in range(queries.shape[0]):
            for j in range(start, end):
                total = np.float32(0.0)
                for k in range(size):
                    total += abs(queries[i, k] - references[j, k])
                result[i, j] = total / np.float32(size)


def enhanced(rows: NDArray[np.float32], half_window: int) -> NDArray[np.float32]:
    """Enhance the local contrast of differences (q, n): deviations from the mean of the references around each.

    The window of reference i is i - half_window..i + half_window, cut off at the ends of the traverse; the deviation
    is that of the whole population. Where all differences of a window are the same there is no contrast: 0.
    """
    result = np.empty_like(rows)
    _enhance(rows, half_window, result)
    return result


@compiled
def _enhance(rows: NDArray[np.float32], half_window: int, result: NDArray[np.float32]) -> None:
    height, width = rows.shape
    for i in range(height):
        for j in range(width):
            start, end = max(0, j - half_window), min(width, j + half_window + 1)
            mean, variance = 0.0, 0.0
            for k in range(start, end):
                mean += rows[i, k]
            mean /= end - start
            for k in range(start, end):
                variance += (rows[i, k] - mean) ** 2
            deviation = math.sqrt(variance / (end - start))
            result[i, j] = (rows[i, j] - mean) / deviation if deviation > _NOISE * mean else 0.0


def _best_sums(rows: NDArray[np.float32], lines: Sequence[Sequence[int]]) -> NDArray[np.float32]:
    """Return the least sum of the trajectories that end at each query and reference, infinite where none fits."""
    length, width = len(lines[0]), rows.shape[1]
    best = np.full((rows.shape[0] - length + 1, width), np.inf, dtype=np.float32)
    for line in lines:
        fitting = best[:, line[-1] :]
        np.minimum(fitting, sums_along(rows, line), out=fitting)
    return best


def _most_unique(
    costs: NDArray[np.float32], settings: SeqSlamSettings
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the reference of least cost for each query (c,), and how unique it is.

    `costs` (c, n) are positive, and infinite where no trajectory ends; they are written over.
    """
    queries = np.arange(costs.shape[0])
    best = costs.argmin(axis=1)
    first = costs[queries, best].astype(np.float64)
    near = best[:, np.newaxis] + np.arange(-settings.half_window, settings.half_window + 1)
    np.put_along_axis(costs, np.clip(near, 0, costs.shape[1] - 1), np.inf, axis=1)
    second = costs.min(axis=1).astype(np.float64)
    second = np.where(np.isfinite(second), second, settings.offset)
    return best, 1.0 - np.minimum(first / second, 1.0)
