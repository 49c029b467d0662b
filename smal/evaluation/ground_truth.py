"""Ground truth: one criterion for all methods of place recognition."""

import math
from dataclasses import dataclass

import numpy as np

from smal.arrays import Bools, Floats, Int64s
from smal.place_recognition import Matches

_BLOCK = 256  # Queries that are compared with all references at a time; limits memory.


@dataclass(frozen=True, eq=False)
class Judgement:
    """Result for every query, in order, arrays (q,)."""

    score: Floats
    #: Whether the query has an answer, and a right answer.
    answered: Bools
    right: Bools
    #: Queries with ground truth; the others do not count.
    judged: Bools
    #: Judged queries with a right reference. Any answer to the other queries is wrong.
    findable: Bools


@dataclass(frozen=True, eq=False)
class IntervalTruth:
    """Intervals of right references. A query has an interval for each visit of its place, or none."""

    #: (k,) query of each interval.
    query: Int64s
    #: (k,), 0 <= first <= last.
    first: Int64s
    last: Int64s
    #: (q,), see `Judgement`.
    judged: Bools

    @property
    def findable(self) -> Bools:
        """See `Judgement`."""
        return np.bincount(self.query, minlength=self.judged.size) > 0

    @property
    def tolerance(self) -> int:
        """Usual tolerance of right references in frames: half of the median interval."""
        return int(np.median(self.last - self.first)) // 2

    def judge(self, matches: Matches) -> Judgement:
        """Judge the answers of a method to the same queries."""
        answers = matches.reference[self.query]
        inside = (answers >= self.first) & (answers <= self.last)
        right = matches.matched & (np.bincount(self.query, inside, self.judged.size) > 0)
        return Judgement(matches.score, matches.matched, right, self.judged, self.findable)


def judge_by_poses(
    matches: Matches, references: Floats, queries: Floats, distance_m: float, angle_deg: float
) -> Judgement:
    """Judge answers: right references are within a distance and an angle of the query; poses (n, 3), (q, 3)."""

    def near(some: Floats, others: Floats) -> Bools:
        apart = some - others
        turn_rad = np.abs(np.remainder(apart[..., 2] + math.pi, 2 * math.pi) - math.pi)
        close: Bools = np.hypot(apart[..., 0], apart[..., 1]) <= distance_m
        return close & (turn_rad <= math.radians(angle_deg))

    starts = range(0, len(queries), _BLOCK)
    blocks = (queries[start : start + _BLOCK, np.newaxis] for start in starts)
    findable = np.concatenate([near(block, references).any(axis=1) for block in blocks])
    right = matches.matched & near(queries, references[matches.reference])
    judged = np.ones(len(queries), dtype=np.bool_)
    return Judgement(matches.score, matches.matched, right, judged, findable)
