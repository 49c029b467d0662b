"""SeqSLAM after the paper (Milford & Wyeth, ICRA 2012): sums of enhanced differences along straight lines."""

import math
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.distance import cdist

from smal.arrays import Float32s, Floats, Int64s
from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.nearest_sequence import sums_along

#: The paper's velocities, reference frames to one query frame.
VELOCITIES: Final = (0.8, 0.9, 1.0, 1.1, 1.2)
#: Half of the paper's R_window: contrast is enhanced among this number of references before and after, and the second
#: best trajectory ends further away.
HALF_WINDOW: Final = 5
#: Number c that makes every sum positive: of k numbers, none is over sqrt(k - 1) deviations off the mean.
_OFFSET: Final = math.sqrt(2 * HALF_WINDOW + 1)
#: Standard deviations below this share of the mean difference are the rounding of float32 sums.
_NOISE: Final = 1e-5


def match_seqslam(
    references: Float32s,
    queries: Float32s,
    length: int,
    progress: Progress = ignore,
) -> Matches:
    """Match each query with the end of the straight trajectory that differs least from the query and its predecessors.

    With D the mean absolute differences, and mean and deviation over the references within R_window / 2 of i:

        D'(t, i) = (D(t, i) - mean) / deviation                      local contrast enhancement
        S(t, e) = min over V of 1/d_s sum_{k=0}^{d_s-1} D'(t - k, e - round(V k))
        e*(t) = argmin over e of S(t, e)                             the match
        score(t) = 1 - (S(t, e*) + c) / (S2(t) + c)                  the uniqueness

    where S2 is the least S of the ends further than R_window / 2 from e*. The paper compares the two by their ratio,
    which is meaningless for negative sums or 0; with c every sum is positive. The paper's trajectories lie around a
    query. These end at it, so that a robot can use them.

    References (n, m) and queries (q, m) are patch-normalised thumbnails in order; a common factor has no effect.
    There is no match for the first d_s - 1 queries, or if no trajectory fits into n. Scores are in [0, 1). If all
    trajectories end within the window, S2 = 0, as for references without any contrast. ValueError if features do not
    fit or are not finite.
    """
    check_features(references, queries)
    total = len(queries)
    count = len(references)
    matches = Matches.none(total)
    lines = [line for line in trajectories(length) if line[-1] < count]
    if min(total, count) >= length and lines:
        rows = enhanced(cdist(queries, references, "cityblock") / queries.shape[1])
        costs = np.full((total - length + 1, count), np.inf, dtype=np.float32)
        for line in lines:
            fitting = costs[:, line[-1] :]
            np.minimum(fitting, sums_along(rows, line), out=fitting)
        costs = costs / np.float32(length) + np.float32(_OFFSET)
        matches.reference[length - 1 :], matches.score[length - 1 :] = _most_unique(costs)
    progress(total)
    return matches


def trajectories(length: int) -> list[list[int]]:
    """Return the different straight lines: references before the end, for 0 to length-1 queries before the end."""
    steps = np.floor(np.outer(VELOCITIES, np.arange(length)) + 0.5).astype(np.int64)
    lines: list[list[int]] = np.unique(steps, axis=0).tolist()
    return lines


def enhanced(rows: Floats) -> Float32s:
    """Enhance local contrast (q, n): z values among the references around each; 0 where all are equal."""

    def around(values: Floats) -> Floats:
        summed: Floats = uniform_filter1d(values, 2 * HALF_WINDOW + 1, mode="constant")
        return summed

    inside = around(np.ones(rows.shape[1]))
    level = rows.mean(axis=1, keepdims=True)
    above = rows - level
    mean = around(above) / inside
    deviation = np.sqrt(np.maximum(around(above**2) / inside - mean**2, 0.0))
    floor = _NOISE * (level + mean)
    contrast = np.zeros(rows.shape)
    np.divide(above - mean, deviation, out=contrast, where=deviation > floor)
    return contrast.astype(np.float32)


def _most_unique(costs: Float32s) -> tuple[Int64s, Floats]:
    """Return the reference of least cost (c, n) > 0 for each query (c,), and its uniqueness; overwrites the costs."""
    queries = np.arange(len(costs))
    best = costs.argmin(axis=1)
    first = costs[queries, best].astype(np.float64)
    apart = np.abs(np.arange(costs.shape[1]) - best[:, None])
    costs[apart <= HALF_WINDOW] = np.inf
    second = costs.min(axis=1).astype(np.float64)
    second = np.where(np.isfinite(second), second, _OFFSET)
    return best, 1.0 - np.minimum(first / second, 1.0)
