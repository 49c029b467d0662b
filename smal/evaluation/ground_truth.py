"""What is right: one criterion for every method of place recognition.

A `Truth` says which references are right for a query; `judge` holds a method's answers against it. Methods differ in
what they answer, never in what they are asked or how it is judged.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

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

    Raises
    ------
    ValueError
        The arrays do not fit each other, or an interval is none.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    judged: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if self.first.ndim != 1 or not self.first.shape == self.last.shape == self.judged.shape:
            raise ValueError(
                f"a truth needs one interval for each query: {self.first.shape}, {self.last.shape}, {self.judged.shape}"
            )
        empty = (self.first == -1) & (self.last == -1)
        wrong = np.flatnonzero(~empty & ((self.first < 0) | (self.last < self.first)))
        if wrong.size:
            query = int(wrong[0])
            raise ValueError(f"query {query}: {self.first[query]} to {self.last[query]} is no interval of references")

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
    distance_m : float
        Right within this distance, 0 or more: 3 m outdoors and 0.35 m indoors are this project's.
    angle_deg : float
        And within this difference of headings, 0 to 180.

    Raises
    ------
    ValueError
        The poses are not of that shape or are infinite, or a limit is out of its range.
    """

    reference_poses: NDArray[np.float64]
    query_poses: NDArray[np.float64]
    distance_m: float
    angle_deg: float = 25.0

    def __post_init__(self) -> None:
        for name, poses in (("reference", self.reference_poses), ("query", self.query_poses)):
            if poses.ndim != 2 or poses.shape[1] != 3:
                raise ValueError(f"{name} poses must be x, y and heading, (n, 3), got the shape {poses.shape}")
            if np.isinf(poses).any():
                raise ValueError(f"{name} poses contain infinity")
        if not 0.0 <= self.distance_m < math.inf or not 0.0 <= self.angle_deg <= 180.0:
            raise ValueError(
                f"right needs a distance of 0 m or more and an angle from 0 to 180 degrees, "
                f"got {self.distance_m} m and {self.angle_deg} degrees"
            )

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
    """What became of every query, in order. All arrays have the shape (q,).

    Parameters
    ----------
    score : float64 array
        Of the answer; means nothing where there is none.
    answered, right : bool arrays
        Whether there is an answer, and whether it is right.
    judged, findable : bool arrays
        See `Truth`.

    Raises
    ------
    ValueError
        The arrays do not fit each other, a score is not finite, or an answer is right where there is none, or none can
        be.
    """

    score: NDArray[np.float64]
    answered: NDArray[np.bool_]
    right: NDArray[np.bool_]
    judged: NDArray[np.bool_]
    findable: NDArray[np.bool_]

    def __post_init__(self) -> None:
        arrays: tuple[NDArray[Any], ...] = (self.answered, self.right, self.judged, self.findable)
        if self.score.ndim != 1 or any(array.shape != self.score.shape for array in arrays):
            raise ValueError(f"a judgement needs arrays of one shape, got {[a.shape for a in (self.score, *arrays)]}")
        if not np.isfinite(self.score[self.answered]).all():
            raise ValueError("a score is not finite")
        if (self.right & ~(self.answered & self.findable)).any() or (self.findable & ~self.judged).any():
            raise ValueError("right are only answers to queries that are judged and have something to find")


def judge(matches: Matches, truth: Truth) -> Judgement:
    """Hold a method's answers against the truth of the same queries."""
    answered, judged = matches.matched, truth.judged
    if answered.shape != judged.shape:
        raise ValueError(f"the truth is about {judged.size} queries, the matches about {answered.size}")
    right = np.zeros_like(answered)
    queries = np.flatnonzero(answered & judged)
    right[queries] = truth.right(queries, matches.reference[queries])
    return Judgement(matches.score, answered, right, judged, truth.findable)
