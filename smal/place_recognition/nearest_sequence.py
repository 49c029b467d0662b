"""Nearest neighbour with the sum over the sequence: the plainest method that knows the order of frames.

The products of every query with every reference are summed along the diagonal, frame by frame at the same speed,
and the reference sequence with the largest sum is the match. There is no optimization and nothing to set but l.
"""

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.trajectories import rolling, sums_along


def match_nearest_sequence(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    length: int,
    progress: Progress = ignore,
) -> Matches:
    """Match each query with the end of the reference sequence that has the largest mean product.

        score(t) = max_j  1/l  sum_{k=0}^{l-1}  x_{j-k} . y_{t-k}

    The vectors x of the references (n, m) and y of the queries (q, m) are centred and weighted (`Centering.apply`), of
    length 1. The window of query t is t-l+1..t, and its match is the frame at t; there is none for the first l-1
    queries, nor for any where n < l. The score is the mean cosine of the window, in [-1, 1]. Of equal sequences the
    earliest is taken. Features that do not fit or are not finite raise ValueError.
    """
    check_features(references, queries, length)
    total, count = len(queries), len(references)
    matches = Matches.none(total)
    for done, rows in rolling(lambda frames: queries[frames] @ references.T, total, count, length):
        means = sums_along(rows, range(length)) / np.float32(length)
        if means.size:
            best = means.argmax(axis=1)
            ends = slice(done - best.size, done)
            matches.reference[ends] = best + length - 1
            matches.score[ends] = means[np.arange(best.size), best]
        progress(done)
    progress(total)
    return matches
