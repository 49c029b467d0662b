"""Straight trajectories through the matrix of queries and references, which several methods sum along."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Entries of the (queries, references) matrix that are held at a time: 8 MB.
_BLOCK_ENTRIES = 1 << 21


def steps_back(speeds: Sequence[float] | NDArray[Any], length: int) -> NDArray[np.int64]:
    """Return how many references before its end a trajectory is, 0 to l-1 queries before its end, (speeds, l).

    That is speed * k, for a speed in references to one query, to the nearest whole reference; halves go up, so that
    half speed advances at every second query.
    """
    steps: NDArray[np.int64] = np.floor(np.outer(speeds, np.arange(length)) + 0.5).astype(np.int64)
    return steps


def rolling(
    compute: Callable[[slice], NDArray[np.float32]], queries: int, references: int, length: int
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Compute a matrix (queries, references) a few rows at a time, so that it need not fit in memory.

    Yields how many queries are done, and the rows (c + length - 1, references) of the last c windows of `length` rows,
    c >= 1: those that end at queries done-c..done-1. Each window comes once.
    """
    step = max(length, _BLOCK_ENTRIES // max(1, references))
    kept = np.empty((0, references), dtype=np.float32)
    for start in range(0, queries, step):
        done = min(start + step, queries)
        rows = np.concatenate([kept, compute(slice(start, done))])
        if rows.shape[0] >= length:
            yield done, rows
        kept = rows[max(0, rows.shape[0] - length + 1) :]


def sums_along(rows: NDArray[np.float32], steps: Sequence[int] | NDArray[np.int64]) -> NDArray[np.float32]:
    """Sum a matrix (c + l - 1, n) of successive queries along one trajectory of l steps, from each of its ends.

    Entry (i, j) of the result (c, max(n - steps[-1], 0)) is the sum of the trajectory that ends at row i + l - 1 and at
    reference j + steps[-1]; those that end earlier would begin before the first reference.
    """
    (height, width), length, reach = rows.shape, len(steps), steps[-1]
    total = np.zeros((height - length + 1, max(width - reach, 0)), dtype=np.float32)
    if reach < width:
        for back, step in enumerate(steps):
            total += rows[length - 1 - back : height - back, reach - step : width - step]
    return total
