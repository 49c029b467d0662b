"""Matching of two traverses: the reference of each query, with its probability.

A query stands out at a reference by z: its cosine less the mean of its cosines with all references, divided by their
spread. Elsewhere z is about normal. Under the present light, z at the right place is unknown. Its mean and spread, and
the newness of each query, are learned from the queries themselves, without labels (expectation-maximization).
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain as chain_of
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from smal.arrays import Float32s, Floats, Indices, Uint16s
from smal.features.extraction import Parallel, in_parallel
from smal.likelihood import GRID, log_ratio, over
from smal.place_recognition.hidden_markov import Chain, smoothed
from smal.place_recognition.matches import Matches, Progress, check_features, ignore

#: z of queries at references, in steps.
Levels = Uint16s
#: A reference, its probability within the tolerance, and the probability of "none".
Best = tuple[int, float, float]

#: Prior of the mean and spread of z at the right place, and of the correlation of successive queries.
_MEAN = 2.0
_SPREAD = 1.5
_CORRELATION = 1.0 / 3.0
#: Weight of the prior, as a number of queries.
_PRIOR_QUERIES = 5
#: Minimum of the spread.
_LEAST_SPREAD = 0.3
#: Maximum of the correlation; larger values come from stretches away from the estimated place.
_MOST_CORRELATION = 0.7
#: Maximum evidence of one query (log ratio).
_MOST_SAID = 30.0
_ROUNDS: Final = 6
#: Levels of z between two values of the `GRID`.
_FINE: Final = 16
_LEVELS: Final = np.linspace(GRID[0], GRID[-1], _FINE * (GRID.size - 1) + 1)
#: Level of a blank query, without evidence.
_SILENT = _LEVELS.size
#: Level of a reference that is excluded for a loop.
_NEVER = _LEVELS.size + 1
_Z: Final = np.append(_LEVELS, [0.0, 0.0]).astype(np.float32)
#: A step shorter than this share of a moving step counts as standing still.
_STANDING: Final = 0.4
#: Queries of a stretch for learning, and the maximum number of stretches.
_STRETCH = 500
_STRETCHES = 4
#: Queries that are answered at a time, with a stretch more on either side. An older view matters only if two long ways
#: among the references look alike and differ even further away.
_PART: Final = _STRETCH * _STRETCHES
#: Queries whose cosines are computed at a time.
_BLOCK: Final = 256


class TraversePart(NamedTuple):
    """Some centred queries in order: the number of the first, and the slice of queries to answer."""

    first: int
    queries: Float32s
    own: slice

    def blocks(self) -> "list[TraversePart]":
        """Split the part into blocks."""
        begins = range(0, len(self.queries), _BLOCK)
        return [
            TraversePart(self.first + begin, self.queries[begin : begin + _BLOCK], slice(None))
            for begin in begins
        ]


class Evidence:
    """Likelihood ratio of a query, here to elsewhere, for each level of z, for the new part of the query."""

    def __init__(
        self, mean: float = _MEAN, spread: float = _SPREAD, correlation: float = _CORRELATION
    ) -> None:
        ratio = log_ratio(_normal((GRID - mean) / spread) / spread, _normal(GRID))
        new = (1.0 - correlation) / (1.0 + correlation)
        said = np.clip(new * np.interp(_LEVELS, GRID, ratio), -_MOST_SAID, _MOST_SAID)
        self._ratio = np.append(np.exp(said), [1.0, 0.0]).astype(np.float32)

    @classmethod
    def learn(cls, levels: Levels, there: Float32s) -> "Evidence":
        """Measure it on queries (q, n) with the estimated probabilities (q, n) of references."""
        z = _Z[levels]
        prior = _PRIOR_QUERIES
        believed = float(there.sum(dtype=np.float64))
        total = float(np.einsum("ij,ij", there, z))
        mean = (total + prior * _MEAN) / (believed + prior)
        squares = float(np.einsum("ij,ij,ij", there, z, z))
        scatter = squares - 2.0 * mean * total + believed * mean**2
        variance = max(scatter + prior * _SPREAD**2, 0.0) / (believed + prior)
        spread = max(math.sqrt(variance), _LEAST_SPREAD)
        off = z[np.arange(len(z)), there.argmax(axis=1)] - mean
        usual = prior * spread**2
        correlation = float(off[1:] @ off[:-1] + _CORRELATION * usual) / float(off @ off + usual)
        return cls(mean, spread, min(max(correlation, 0.0), _MOST_CORRELATION))

    def of(self, levels: Levels) -> Float32s:
        """Return the likelihood ratios of levels."""
        return self._ratio[levels]


class Places:
    """Centred references (n, m), without stops; loops exclude references less than ``apart`` frames before."""

    def __init__(
        self, references: Float32s, frames: Indices, tolerance: int, apart: int | None
    ) -> None:
        self.chain = Chain(len(references))
        self._references = references
        self._apart = apart
        self._frames = frames
        self._first = np.searchsorted(frames, frames - tolerance)
        self._end = np.searchsorted(frames, frames + tolerance, "right")

    def levels(self, part: TraversePart) -> Levels:
        """Return the levels of z of queries at the references."""
        levels = np.empty((len(part.queries), len(self._references)), np.uint16)
        for begin in range(0, len(levels), _BLOCK):
            z = part.queries[begin : begin + _BLOCK] @ self._references.T
            for row, level in zip(z, levels[begin : begin + _BLOCK], strict=True):
                row[:] = over(row, float(row.mean()), float(row.std()))
                steps = np.float32(1.0 / (_LEVELS[1] - _LEVELS[0]))
                place = np.rint((row - np.float32(GRID[0])) * steps)
                level[:] = np.clip(place, 0, _LEVELS.size - 1) if row.any() else _SILENT
        if self._apart is not None:
            for query, level in enumerate(levels, part.first):
                level[max(query - self._apart + 1, 0) :] = _NEVER
        return levels

    def answers(
        self, evidence: Evidence, part: TraversePart, levels: Levels | None = None
    ) -> list[Best]:
        """Return the best answers to a part's own queries, in order, given all of its queries."""
        levels = self.levels(part) if levels is None else levels
        beliefs = smoothed(self.chain, levels, evidence.of)
        found = [self.best(there, none) for _, there, none in beliefs]
        return found[::-1][part.own]

    def best(self, there: Float32s, none: float) -> Best:
        """Return the most probable frame, its probability within the tolerance, and the probability of "none"."""
        best = there.argmax()
        within = there[self._first[best] : self._end[best]]
        return int(self._frames[best]), float(within.sum(dtype=float)), none


def match_places(
    references: Float32s,
    queries: Float32s,
    tolerance: int | None = None,
    lag: int | None = None,
    progress: Progress = ignore,
    parallel: Parallel = in_parallel,
    *,
    loops: bool = False,
) -> Matches:
    """Match every query with its most probable reference.

    Memory is limited: `parallel` works on parts of 2,000 queries, with 500 more on either side. Two ways that look
    alike for longer are not distinguished by views beyond, so that each is half as probable.

    Parameters
    ----------
    references : array (n, m)
        Centred features, in order.
    queries : array (q, m)
        Centred features, in order.
    tolerance : int, optional
        Distance in frames within which references are right; by default the distance within which they look alike.
    lag : int, optional
        Number of later queries that contribute to an answer; by default all of its part.
    progress, parallel
        As in `Matches` and `in_parallel`.
    loops : bool
        Whether the queries are the references, matched with references too far back to look alike by being near.

    Returns
    -------
    Matches
        The score is the probability of being right within the tolerance.

    Raises
    ------
    ValueError
        If features do not fit each other or are not finite.
    """
    check_features(references, queries)
    steps = [float(np.linalg.norm(after - before)) for before, after in pairwise(references)]
    standing = _STANDING * float(np.quantile(steps, 0.75)) if steps else 0.0
    known = moving(references, standing)
    asked = moving(queries, standing)
    tolerance = alike(references[known], 0.5) if tolerance is None else tolerance
    apart = max(alike(references[known], 0.0), tolerance + 1) if loops else None
    # The middle of each stop.
    frames = (known + np.append(known[1:], len(references)) - 1) // 2
    places = Places(references[known], frames, tolerance, apart)
    moved = queries[asked]

    def part(first: int, end: int, margin: int = 0) -> TraversePart:
        begin = max(first - margin, 0)
        return TraversePart(begin, moved[begin : end + margin], slice(first - begin, end - begin))

    if lag is None:
        answers = _smoothed(places, part, len(asked), progress, parallel)
    else:
        answers = _followed(places, part, asked, lag, progress)
    found = Matches.none(len(asked))
    for query, best in enumerate(answers):
        found.reference[query], found.score[query], found.unknown[query] = best
    progress(len(queries))
    return found.of(np.searchsorted(asked, np.arange(len(queries)), "right") - 1)


def moving(features: Float32s, standing: float) -> Indices:
    """Return the frames of a traverse (n, m) that differ from the last returned frame: a stop is one place."""
    kept = [0]
    for frame in range(1, len(features)):
        if np.linalg.norm(features[frame] - features[kept[-1]]) > standing:
            kept.append(frame)
    return np.array(kept)


def alike(references: Float32s, cosine: float) -> int:
    """Return the distance in frames at which the mean cosine of references (n, m) falls below `cosine`, at least 1."""
    for step in range(1, len(references)):
        if np.einsum("ij,ij->i", references[step:], references[:-step]).mean() < cosine:
            return step
    return max(len(references) - 1, 1)


def _smoothed(
    places: Places,
    part: Callable[..., TraversePart],
    count: int,
    progress: Progress,
    parallel: Parallel,
) -> Iterator[Best]:
    """Yield the best answers to `count` queries, each given the queries before and after it."""
    learned = _stretches(part, count)
    levels = [np.concatenate(list(parallel(places.levels, one.blocks()))) for one in learned]
    evidence = _learned(places.chain, levels, progress)
    if count <= _PART:
        yield from places.answers(evidence, part(0, count), levels[0])
        return
    parts = [part(first, min(first + _PART, count), _STRETCH) for first in range(0, count, _PART)]
    done = 0
    for answers in parallel(partial(places.answers, evidence), parts):
        yield from answers
        done += len(answers)
        progress(done)


def _stretches(part: Callable[..., TraversePart], count: int) -> list[TraversePart]:
    """Return the stretches for learning: all queries, or a few evenly spread stretches."""
    if count <= _PART:
        return [part(0, count)]
    starts = np.linspace(0, count - _STRETCH, _STRETCHES).astype(int).tolist()
    return [part(start, start + _STRETCH) for start in starts]


def _learned(chain: Chain, stretches: list[Levels], progress: Progress = ignore) -> Evidence:
    """Return the evidence learned from stretches (q, n)."""
    evidence = Evidence()
    every = np.concatenate(stretches)
    for done in range(1, _ROUNDS):
        answered = in_parallel(partial(_there, chain, evidence), stretches)
        evidence = Evidence.learn(every, np.concatenate(list(answered)))
        progress(len(every) * done // _ROUNDS)
    return evidence


def _there(chain: Chain, evidence: Evidence, levels: Levels) -> Float32s:
    """Return the probabilities (q, n) of a stretch."""
    beliefs = [there for _, there, _ in smoothed(chain, levels, evidence.of)]
    return np.array(beliefs[::-1])


def _followed(
    places: Places,
    part: Callable[..., TraversePart],
    frames: Indices,
    lag: int,
    progress: Progress,
) -> Iterator[Best]:
    """Yield the best answer to each query given those up to `lag` frames after it, and update the evidence."""
    recent = deque[tuple[int, Float32s, Float32s]]()
    chain = places.chain

    def oldest() -> Best:
        message = np.ones_like(belief)
        for _, _, ratios in list(recent)[:0:-1]:
            message = chain.back(chain.weighed(message, ratios))
        query, then, _ = recent.popleft()
        progress(int(frames[query]) + 1)
        return places.best(*chain.at_references(then * message))

    evidence = Evidence()
    belief = chain.first()
    rows = chain_of.from_iterable(map(places.levels, part(0, len(frames)).blocks()))
    for query, row in enumerate(rows):
        # Learned anew when the number of queries has doubled: at powers of two.
        if query.bit_count() == 1:
            evidence = _learned(chain, [places.levels(one) for one in _stretches(part, query)])
        while recent and frames[query] - frames[recent[0][0]] > lag:
            yield oldest()
        ratios = evidence.of(row)
        belief = chain.weighed(chain.ahead(belief) if query else belief, ratios)
        recent.append((query, belief, ratios))
    while recent:
        yield oldest()


def _normal(z: Floats) -> Floats:
    return np.maximum(np.exp(-0.5 * np.square(z)), 1e-300)
