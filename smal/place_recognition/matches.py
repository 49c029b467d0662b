"""Input checks and results of all methods of place recognition."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from smal.arrays import Bools, Float32s, Floats, Int64s

#: Called with the number of finished queries.
Progress = Callable[[int], None]


def ignore(_done: int) -> None:
    """Ignore the progress."""


NONE = -1  # No reference, in `Matches.reference`.


@dataclass(frozen=True, eq=False)
class Matches:
    """At most one match for every query frame.

    Attributes
    ----------
    reference : array (q,)
        Matched frame, 0 to n - 1, or `NONE`: before the first whole window, and if nothing was recognised.
    score : array (q,)
        Confidence, comparable between the queries of one method only; 0 without a match.
    unknown : array (q,)
        Probability that no reference shows the query; 0 for a method without this estimate.
    """

    reference: Int64s
    score: Floats
    unknown: Floats

    @classmethod
    def none(cls, queries: int) -> Self:
        """Return matches in which no query is recognised."""
        return cls(np.full(queries, NONE, dtype=np.int64), np.zeros(queries), np.zeros(queries))

    def above(self, threshold: float) -> Self:
        """Return the matches with a score above a threshold; the others are removed."""
        sure = self.matched & (self.score > threshold)
        return replace(
            self,
            reference=np.where(sure, self.reference, NONE),
            score=np.where(sure, self.score, 0.0),
        )

    def surest(self, precision: float) -> Self:
        """Keep the most confident matches at this precision; scores must be probabilities."""
        falling = np.sort(self.score[self.matched])[::-1]
        expected = np.cumsum(falling) / np.arange(1, falling.size + 1)
        enough = falling[expected >= precision]
        threshold = np.nextafter(enough[-1], 0.0) if enough.size else math.inf
        return self.above(threshold)

    def of(self, queries: Int64s) -> Self:
        """Return the matches of some queries."""
        return type(self)(self.reference[queries], self.score[queries], self.unknown[queries])

    @property
    def matched(self) -> Bools:
        """Which queries have a match, (q,)."""
        found: Bools = self.reference != NONE
        return found


def check_features(references: Float32s, queries: Float32s) -> None:
    """Raise ValueError unless features are two arrays (n, m) and (q, m) of finite numbers."""
    if references.ndim != 2 or queries.ndim != 2 or references.shape[1] != queries.shape[1]:
        raise ValueError(
            f"features must have the shapes (n, m) and (q, m), got {references.shape} and {queries.shape}"
        )
    for name, features in (("references", references), ("queries", queries)):
        # A sum is finite only if all entries are, and needs no further memory.
        if not np.isfinite(features.sum(dtype=np.float64)):
            raise ValueError(f"features of the {name} contain NaN or infinity")
