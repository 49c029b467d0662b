"""What is right: one criterion for every method of place recognition.

A `Truth` says which references are right for a query; `judge` holds a method's answers against it. Methods differ in
what they answer, never in what they are asked or how it is judged.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition import Matches

#: Queries that are compared with all references at a time: 20 MB of each number for 10,000 references.
_BLOCK = 256


class Truth(Protocol):
    """Which references show the place of a query."""

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Which queries something is known about, (q,). The others do not count at all."""

    @property
    def findable(self) -> NDArray[np.bool_]:
        """Which queries are judged and have a right reference, (q,). Any answer to the other judged ones is wrong."""

    def right(self, queries: NDArray[np.int64], references: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether references (0..n-1) are right for queries (0..q-1), of two arrays that broadcast."""


@dataclass(frozen=True, eq=False)
class IntervalTruth:
    """Right are all references from a first to a last one.

    Parameters
    ----------
    first, last : int64 arrays (q,)
        0 <= first <= last, or both -1 where the reference traverse does not show the place.
    judged : bool array (q,)
        See `Truth`.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    judged: NDArray[np.bool_]

    @property
    def findable(self) -> NDArray[np.bool_]:
        """See `Truth`."""
        found: NDArray[np.bool_] = self.judged & (self.first >= 0)
        return found

    def right(self, queries: NDArray[np.int64], references: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See `Truth`."""
        inside = (references >= self.first[queries]) & (references <= self.last[queries])
        result: NDArray[np.bool_] = inside & self.findable[queries]
        return result


@dataclass(frozen=True, eq=False)
class PoseTruth:
    """Right are all references that were taken near a query and look the same way.

    Parameters
    ----------
    reference_poses, query_poses : float64 arrays (n, 3), (q, 3)
        x and y in metres, heading in radians. Where a pose is not known (NaN) the query is not judged, and the
        reference is right for none.
    distance_m, angle_deg : float
        Right within both: 3 m outdoors and 0.35 m indoors are this project's.
    """

    reference_poses: NDArray[np.float64]
    query_poses: NDArray[np.float64]
    distance_m: float
    angle_deg: float = 25.0

    @property
    def judged(self) -> NDArray[np.bool_]:
        """See `Truth`."""
        return np.asarray(np.isfinite(self.query_poses).all(axis=1))

    @cached_property
    def findable(self) -> NDArray[np.bool_]:
        """See `Truth`."""
        result = np.zeros(self.query_poses.shape[0], dtype=np.bool_)
        references = np.arange(self.reference_poses.shape[0])
        for start in range(0, result.size, _BLOCK):
            queries = np.arange(start, min(start + _BLOCK, result.size))
            result[queries] = self.right(queries[:, np.newaxis], references).any(axis=1)
        return result

    def right(self, queries: NDArray[np.int64], references: NDArray[np.int64]) -> NDArray[np.bool_]:
        """See `Truth`."""
        apart = self.query_poses[queries] - self.reference_poses[references]
        near = np.hypot(apart[..., 0], apart[..., 1]) <= self.distance_m
        turn_rad = np.abs(np.remainder(apart[..., 2] + math.pi, 2 * math.pi) - math.pi)
        # Nothing compares with NaN, so what is not known is not right.
        return np.asarray(near & (np.degrees(turn_rad) <= self.angle_deg))


@dataclass(frozen=True, eq=False)
class Judgement:
    """What became of every query, in order, arrays (q,): its answer's score, whether it has one, and a right one.

    For ``judged`` and ``findable`` see `Truth`.
    """

    score: NDArray[np.float64]
    answered: NDArray[np.bool_]
    right: NDArray[np.bool_]
    judged: NDArray[np.bool_]
    findable: NDArray[np.bool_]


def judge(matches: Matches, truth: Truth) -> Judgement:
    """Hold a method's answers against the truth of the same queries."""
    answered, judged = matches.matched, truth.judged
    if answered.shape != judged.shape:
        raise ValueError(f"the truth is about {judged.size} queries, the matches about {answered.size}")
    right = np.zeros_like(answered)
    queries = np.flatnonzero(answered & judged)
    right[queries] = truth.right(queries, matches.reference[queries])
    return Judgement(matches.score, answered, right, judged, truth.findable)
