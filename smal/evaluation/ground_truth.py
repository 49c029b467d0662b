"""What is right: one criterion for every method of place recognition, whatever it answers."""

import math
from dataclasses import dataclass

import numpy as np

from smal.arrays import Bools, Floats, Int64s
from smal.place_recognition import Matches

_BLOCK = 256  # Queries that are compared with all references at a time: 20 MB of each number for 10,000 references.


@dataclass(frozen=True, eq=False)
class Judgement:
    """What became of every query, in order, arrays (q,): its answer's score, whether it has one, and a right one."""

    score: Floats
    answered: Bools
    right: Bools
    judged: Bools  # Those of which something is known; the others do not count at all.
    findable: (
        Bools  # Judged ones that have a right reference: any answer to the other ones is wrong.
    )


@dataclass(frozen=True, eq=False)
class IntervalTruth:
    """Right are references from a first to a last one; a query has as many intervals as its place is shown, or none."""

    query: Int64s  # (k,) of each interval.
    first: Int64s  # (k,), 0 <= first <= last.
    last: Int64s
    judged: Bools  # (q,), see `Judgement`.

    @property
    def findable(self) -> Bools:
        """See `Judgement`."""
        return np.bincount(self.query, minlength=self.judged.size) > 0

    @property
    def tolerance(self) -> int:
        """How many frames off a reference usually still is right: half of the median interval."""
        return int(np.median(self.last - self.first)) // 2

    def judge(self, matches: Matches) -> Judgement:
        """Hold a method's answers against this truth of the same queries."""
        answers = matches.reference[self.query]
        inside = (answers >= self.first) & (answers <= self.last)
        right = matches.matched & (np.bincount(self.query, inside, self.judged.size) > 0)
        return Judgement(matches.score, matches.matched, right, self.judged, self.findable)


def judge_by_poses(
    matches: Matches, references: Floats, queries: Floats, distance_m: float, angle_deg: float
) -> Judgement:
    """Judge answers: right is a reference within a distance and an angle of the query; poses (n, 3), (q, 3)."""

    def near(some: Floats, others: Floats) -> Bools:
        apart = some - others
        turn_rad = np.abs(np.remainder(apart[..., 2] + math.pi, 2 * math.pi) - math.pi)
        close: Bools = np.hypot(apart[..., 0], apart[..., 1]) <= distance_m
        return close & (turn_rad <= math.radians(angle_deg))

    blocks = (
        queries[start : start + _BLOCK, np.newaxis] for start in range(0, len(queries), _BLOCK)
    )
    findable = np.concatenate([near(block, references).any(axis=1) for block in blocks])
    right = matches.matched & near(queries, references[matches.reference])
    return Judgement(
        matches.score, matches.matched, right, np.ones(len(queries), dtype=np.bool_), findable
    )
