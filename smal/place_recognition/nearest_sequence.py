"""Nearest neighbour with the sum over the sequence: the simplest method that uses the order of frames."""

from collections.abc import Sequence

import numpy as np

from smal.arrays import Float32s
from smal.place_recognition.matches import Matches, Progress, check_features, ignore


def match_nearest_sequence(
    references: Float32s,
    queries: Float32s,
    length: int,
    progress: Progress = ignore,
) -> Matches:
    """Match each query (q, m) with the end of the reference sequence (n, m) that has the largest mean product.

        score(t) = max_j  1/l  sum_{k=0}^{l-1}  x_{j-k} . y_{t-k}

    Vectors are centred (`Centering.apply`). There is no match for the first l-1 queries, or if n < l. Of equal
    sequences the earliest is taken. ValueError if features do not fit or are not finite.
    """
    check_features(references, queries)
    matches = Matches.none(len(queries))
    means = sums_along(queries @ references.T, range(length)) / np.float32(length)
    if means.size:
        best = means.argmax(axis=1)
        matches.reference[length - 1 :] = best + length - 1
        matches.score[length - 1 :] = means[np.arange(best.size), best]
    progress(len(queries))
    return matches


def sums_along(rows: Float32s, steps: Sequence[int]) -> Float32s:
    """Sum a matrix (q, n) of queries and references along one straight line of l steps, from each of its ends.

    Steps are references before the end, for 0 to l-1 queries before the end. Entry (i, j) of the result
    (q - l + 1, max(n - steps[-1], 0)) is the sum of the line that ends at row i + l - 1 and at reference j + steps[-1].
    Lines with earlier ends begin before the first reference.
    """
    height, width = rows.shape
    length = len(steps)
    reach = steps[-1]
    total = np.zeros((max(height - length + 1, 0), max(width - reach, 0)), dtype=np.float32)
    if total.size:
        for back, step in enumerate(steps):
            total += rows[length - 1 - back : height - back, reach - step : width - step]
    return total
