"""What every method of place recognition takes and answers."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from smal.arrays import Bools, Float32s, Floats, Int64s

Progress = Callable[[int], None]  # Called with the number of queries that are done.


def ignore(_done: int) -> None:
    """Take notice of no progress."""


NONE = -1  # Stands for no reference frame in `Matches.reference`.


@dataclass(frozen=True, eq=False)
class Matches:
    """One match for every query frame, or none; arrays (q,).

    `reference` is its frame, 0 to n - 1, or `NONE`: before the first whole window, and where nothing was recognized.
    `score` says how sure the match is: higher is surer, comparable between the queries of one method only, 0 where
    there is no match. `unknown` is the probability that no reference shows the query; 0 of a method that does not tell.
    """

    reference: Int64s
    score: Floats
    unknown: Floats

    @classmethod
    def none(cls, queries: int) -> Self:
        """Return the answer that recognizes no query of `queries`."""
        return cls(np.full(queries, NONE, dtype=np.int64), np.zeros(queries), np.zeros(queries))

    def above(self, threshold: float) -> Self:
        """Return the matches with a score above a threshold; the others are none."""
        sure = self.matched & (self.score > threshold)
        return replace(
            self,
            reference=np.where(sure, self.reference, NONE),
            score=np.where(sure, self.score, 0.0),
        )

    def surest(self, precision: float) -> Self:
        """Return as many of the surest matches as have this precision, by scores that are probabilities."""
        falling = np.sort(self.score[self.matched])[::-1]
        expected = np.cumsum(falling) / np.arange(1, falling.size + 1)
        enough = falling[expected >= precision]
        return self.above(np.nextafter(enough[-1], 0.0) if enough.size else math.inf)

    def of(self, queries: Int64s) -> Self:
        """Return the matches of some queries."""
        return type(self)(self.reference[queries], self.score[queries], self.unknown[queries])

    @property
    def matched(self) -> Bools:
        """Which queries have a match, (q,)."""
        found: Bools = self.reference != NONE
        return found


def check_features(references: Float32s, queries: Float32s) -> None:
    """Refuse features that are not two arrays (n, m) and (q, m) of finite numbers."""
    if references.ndim != 2 or queries.ndim != 2 or references.shape[1] != queries.shape[1]:
        raise ValueError(
            f"features must have the shapes (n, m) and (q, m), got {references.shape} and {queries.shape}"
        )
    for name, features in (("references", references), ("queries", queries)):
        # A sum is not finite if an entry is not, and takes no memory of the features' size.
        if not np.isfinite(features.sum(dtype=np.float64)):
            raise ValueError(f"features of the {name} contain NaN or infinity")
