"""What every method of place recognition takes and answers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

#: Called with the number of queries that are done.
Progress = Callable[[int], None]


def ignore(_done: int) -> None:
    """Take notice of no progress."""


#: Stands for no reference frame in `Matches.reference`.
NONE = -1


@dataclass(frozen=True, eq=False)
class Matches:
    """One match for every query frame, or none.

    Parameters
    ----------
    reference : int64 array (q,)
        Reference frame, 0 to n - 1; `NONE` before the first whole window, and where nothing was recognized.
    score : float64 array (q,)
        How sure the match is: higher is surer, comparable between the queries of one method only. 0 where there is no
        match.
    """

    reference: NDArray[np.int64]
    score: NDArray[np.float64]

    @classmethod
    def none(cls, queries: int) -> Self:
        """Return the answer that recognizes no query of `queries`."""
        return cls(np.full(queries, NONE, dtype=np.int64), np.zeros(queries))

    def above(self, threshold: float) -> Self:
        """Return the matches with a score above a threshold; the others are none."""
        sure = self.matched & (self.score > threshold)
        return type(self)(np.where(sure, self.reference, NONE), np.where(sure, self.score, 0.0))

    def of(self, queries: NDArray[np.int64]) -> Self:
        """Return the matches of some queries."""
        return type(self)(self.reference[queries], self.score[queries])

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Which queries have a match, (q,)."""
        found: NDArray[np.bool_] = self.reference != NONE
        return found


def check_features(references: NDArray[np.float32], queries: NDArray[np.float32], length: int = 1) -> None:
    """Refuse features that are not two arrays (n, m) and (q, m) of finite numbers, and windows of no frame."""
    if length < 1:
        raise ValueError(f"a window needs a length of at least 1, got {length}")
    if references.ndim != 2 or queries.ndim != 2 or references.shape[1] != queries.shape[1]:
        raise ValueError(f"features must have the shapes (n, m) and (q, m), got {references.shape} and {queries.shape}")
    for name, features in (("references", references), ("queries", queries)):
        # A sum is not finite if an entry is not, and takes no memory of the features' size.
        if not np.isfinite(features.sum(dtype=np.float64)):
            raise ValueError(f"features of the {name} contain NaN or infinity")
