"""An index of views: which of very many may be near a query, found by looking at a few.

Inverted lists: k-means of a sample puts each view on the list of its nearest centre, and a query looks at the lists of
the centres nearest to it until there are enough candidates. With about sqrt(n) lists of sqrt(n) views a query takes
about as long as 2 sqrt(n) products. Of the views themselves it keeps nothing, so that they may lie on disk.
"""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

#: Views a list that k-means sees, its rounds, and rows that are read at a time.
_SAMPLE, _ROUNDS, _BLOCK = 20, 8, 8192
Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PlaceIndex:
    """Lists of views.

    Parameters
    ----------
    centres : float32 array (k, r)
        Of length 1, one a list.
    rows : int64 array (n,)
        The views, list after list.
    starts : int64 array (k + 1,)
        Where each list begins among them.
    """

    centres: Array
    rows: NDArray[np.int64]
    starts: NDArray[np.int64]

    @classmethod
    def build(cls, vectors: NDArray[Any], seed: int = 0) -> Self:
        """Index the views (n, r), floats of length 1 that may be memory-mapped; n is at least 1."""
        rng, count = np.random.default_rng(seed), math.isqrt(len(vectors))
        some = np.sort(rng.choice(len(vectors), min(_SAMPLE * count, len(vectors)), replace=False))
        sample = np.asarray(vectors[some], dtype=np.float32)
        centres = sample[rng.choice(len(sample), count, replace=False)]
        for _ in range(_ROUNDS):
            sums = np.zeros_like(centres)
            np.add.at(sums, _nearest(sample, centres), sample)
            length = np.linalg.norm(sums, axis=1, keepdims=True)
            # A centre without views stays.
            centres = np.where(length > 0.0, sums / np.maximum(length, 1e-12), centres)
        lists = _nearest(vectors, centres)
        starts = np.searchsorted(np.sort(lists), np.arange(count + 1))
        return cls(centres, np.argsort(lists, kind="stable"), starts)

    def near(self, query: NDArray[Any], count: int) -> NDArray[np.int64]:
        """Return at least `count` views (c,) on the lists whose centres are nearest to a query (r,), if there are any.

        Which of them are the nearest ones the caller sees by their vectors.
        """
        order = np.argsort(-(self.centres @ np.asarray(query, dtype=np.float32)))
        sizes = np.cumsum((self.starts[1:] - self.starts[:-1])[order])
        enough = order[: np.searchsorted(sizes, count) + 1]
        return np.concatenate([self.rows[self.starts[one] : self.starts[one + 1]] for one in enough])


def _nearest(vectors: NDArray[Any], centres: Array) -> NDArray[np.int64]:
    """Return the nearest centre of each vector (n,)."""
    blocks = (np.asarray(vectors[start : start + _BLOCK], np.float32) for start in range(0, len(vectors), _BLOCK))
    return np.concatenate([(block @ centres.T).argmax(axis=1) for block in blocks])
