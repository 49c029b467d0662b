"""Nearest neighbour with the sum over the sequence: the plainest method that knows the order of frames.

The products of every query with every reference are summed along the diagonal, frame by frame at the same speed,
and the reference sequence with the largest sum is the match. There is no optimisation and nothing to set but l.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches, Progress, check_features

#: Entries of the (queries, references) matrix that are held at a time: 8 MB.
_BLOCK_ENTRIES = 1 << 21


def match_nearest_sequence(
    references: NDArray[np.float32], queries: NDArray[np.float32], length: int, progress: Progress
) -> Matches:
    """Match each query with the end of the reference sequence that has the largest mean product.

        score(t) = max_j  1/l  sum_{k=0}^{l-1}  x_{j-k} . y_{t-k}

    Parameters
    ----------
    references : float32 array (n, m)
        In order, centred and weighted (`Centering.apply`), one vector x of length 1 each.
    queries : float32 array (q, m)
        Likewise; the vectors y.
    length : int
        Frames l of a window, at least 1. The window of query t is t-l+1..t, and its match is the frame at t.
    progress : callable
        Called with the number of queries that are done.

    Returns
    -------
    Matches
        None for the first l-1 queries, nor for any where n < l. With vectors of length 1 the score is the mean cosine
        of the window, in [-1, 1]. Of equal sequences the earliest.

    Raises
    ------
    ValueError
        The features do not fit each other or are not finite, or l is below 1.
    """
    check_features(references, queries)
    if length < 1:
        raise ValueError(f"a sequence needs a length of at least 1, got {length}")
    matches = Matches.none(queries.shape[0])
    if length > references.shape[0]:
        progress(queries.shape[0])
        return matches
    templates = references.T

    def similarity(frames: slice) -> NDArray[np.float32]:
        return queries[frames] @ templates

    for done, rows in rolling(similarity, queries.shape[0], references.shape[0], length):
        means = sums_along(rows, range(length)) / np.float32(length)
        best = means.argmax(axis=1)
        ends = slice(done - best.size, done)
        matches.reference[ends] = best + length - 1
        matches.score[ends] = means[np.arange(best.size), best]
        progress(done)
    progress(queries.shape[0])
    return matches


def rolling(
    compute: Callable[[slice], NDArray[np.float32]], queries: int, references: int, length: int
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Compute a matrix (queries, references) a few rows at a time, so that it need not fit in memory.

    Parameters
    ----------
    compute : callable
        From a slice of queries to its rows, (rows, references).
    queries, references : int
        Size of the matrix.
    length : int
        Rows that a window takes, at least 1.

    Yields
    ------
    done : int
        Queries so far.
    rows : float32 array (c + length - 1, references)
        Of the last c windows, c >= 1: those that end at queries done-c..done-1. Each window comes once.
    """
    step = max(length, _BLOCK_ENTRIES // max(1, references))
    kept = np.empty((0, references), dtype=np.float32)
    for start in range(0, queries, step):
        done = min(start + step, queries)
        rows = np.concatenate([kept, compute(slice(start, done))])
        if rows.shape[0] >= length:
            yield done, rows
        kept = rows[max(0, rows.shape[0] - length + 1) :]


def sums_along(rows: NDArray[np.float32], steps: Sequence[int]) -> NDArray[np.float32]:
    """Sum a matrix along one trajectory, from each of its ends.

    Parameters
    ----------
    rows : float32 array (c + l - 1, n)
        Of successive queries.
    steps : sequence of l ints
        How many references before its end the trajectory is, 0, 1, ... l-1 queries before its end; not falling,
        from 0 to at most n - 1.

    Returns
    -------
    float32 array (c, n - steps[-1])
        Entry (i, j) is the sum of the trajectory that ends at row i + l - 1 and at reference j + steps[-1]; those that
        end earlier would begin before the first reference.
    """
    (height, width), length, reach = rows.shape, len(steps), steps[-1]
    total = np.zeros((height - length + 1, width - reach), dtype=np.float32)
    for back, step in enumerate(steps):
        total += rows[length - 1 - back : height - back, reach - step : width - step]
    return total
