"""The method on two traverses: where the queries are among the references, and how probable that is.

A query stands out at a reference by z: its cosine less the mean of those with all references, over their spread.
Elsewhere z is about normal. Nobody has taught how far the right place stands out in this light: the mean and the spread
there are learned from the queries themselves, without labels (expectation-maximization), and so is how much of each
query is new.
"""

import math
from collections import deque
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.features.extraction import in_parallel
from smal.likelihood import GRID, log_ratio, over
from smal.place_recognition.hidden_markov import Array, Chain, smoothed
from smal.place_recognition.matches import Matches, Progress, check_features, ignore

Levels = NDArray[np.uint16]  # How far queries stand out at references, in steps of z.
Answer = tuple[int, Array, float]  # A query, the probabilities of references (n,), and of none.

#: Mean and spread of z at the right place, and correlation of successive queries, before anything is learned; and as
#: many queries as that counts.
_MEAN, _SPREAD, _CORRELATION, _PRIOR_QUERIES = 2.0, 1.5, 1.0 / 3.0, 5
#: Least spread, and most correlation (more comes of stretches that are not at the believed place); the most that one
#: query says (log ratio).
_LEAST_SPREAD, _MOST_CORRELATION, _MOST_SAID = 0.3, 0.7, 30.0
_ROUNDS: Final = 6
#: z is held as one of so many levels between two of the `GRID`; after them come that a blank query says nothing, and
#: that a loop does not lead to a reference.
_FINE: Final = 16
_LEVELS: Final = np.linspace(GRID[0], GRID[-1], _FINE * (GRID.size - 1) + 1)
_SILENT, _NEVER = _LEVELS.size, _LEVELS.size + 1
_Z: Final = np.append(_LEVELS, [0.0, 0.0]).astype(np.float32)
_STANDING: Final = 0.4  # A step shorter than this share of one in moving is one of standing still.
_STRETCH, _STRETCHES = 500, 4  # It learns from stretches of so many queries, at most as many of them.
_BLOCK: Final = 256  # Queries whose cosines are computed at a time.


class Evidence:
    """The likelihood ratio of a query, here against elsewhere, for each z, of the part of the query that is new."""

    def __init__(self, mean: float = _MEAN, spread: float = _SPREAD, correlation: float = _CORRELATION) -> None:
        ratio = log_ratio(_normal((GRID - mean) / spread) / spread, _normal(GRID))
        new = (1.0 - correlation) / (1.0 + correlation)
        said = np.clip(new * np.interp(_LEVELS, GRID, ratio), -_MOST_SAID, _MOST_SAID)
        self._ratio = np.append(np.exp(said), [1.0, 0.0]).astype(np.float32)

    @classmethod
    def learn(cls, levels: Levels, there: Array) -> "Evidence":
        """Measure it on queries (q, n) that are believed to show references with probabilities (q, n)."""
        z, prior, believed = _Z[levels], _PRIOR_QUERIES, float(there.sum(dtype=np.float64))
        total = float(np.einsum("ij,ij", there, z))
        mean = (total + prior * _MEAN) / (believed + prior)
        scatter = float(np.einsum("ij,ij,ij", there, z, z)) - 2.0 * mean * total + believed * mean**2
        spread = max(math.sqrt(max(scatter + prior * _SPREAD**2, 0.0) / (believed + prior)), _LEAST_SPREAD)
        off, usual = z[np.arange(len(z)), there.argmax(axis=1)] - mean, prior * spread**2
        correlation = float(off[1:] @ off[:-1] + _CORRELATION * usual) / float(off @ off + usual)
        return cls(mean, spread, min(max(correlation, 0.0), _MOST_CORRELATION))

    def of(self, levels: Levels) -> Array:
        """Return the likelihood ratios of levels."""
        return self._ratio[levels]


def match_places(
    references: Array,
    queries: Array,
    tolerance: int | None = None,
    lag: int | None = None,
    progress: Progress = ignore,
    *,
    loops: bool = False,
) -> Matches:
    """Match every query (q, m) with the reference (n, m) that it most probably shows; both are centred, in order.

    References up to `tolerance` frames away are right as well; if it is None, those that look alike. Each query is
    answered by those up to `lag` after it, or by all. For loops the queries are the references, matched with those that
    are too far back to look alike only because they are near. The score is the probability of being right within the
    tolerance. Features that do not fit each other or are not finite raise ValueError.
    """
    check_features(references, queries)
    steps = [float(np.linalg.norm(after - before)) for before, after in pairwise(references)]
    standing = _STANDING * float(np.quantile(steps, 0.75)) if steps else 0.0
    known, asked = moving(references, standing), moving(queries, standing)
    tolerance = alike(references[known], 0.5) if tolerance is None else tolerance
    levels = _levels(references, queries, known, asked)
    if loops:
        apart = max(alike(references[known], 0.0), tolerance + 1)
        for row in range(len(asked)):
            levels[row, max(row - apart + 1, 0) :] = _NEVER
    # The middle of each stop, and which of them are within the tolerance of each.
    frames = (known + np.append(known[1:], len(references)) - 1) // 2
    first, end = np.searchsorted(frames, frames - tolerance), np.searchsorted(frames, frames + tolerance, "right")
    found, chain = Matches.none(len(asked)), Chain(len(known))
    if lag is None:
        answers = smoothed(chain, levels, _learned(chain, levels, progress).of)
    else:
        answers = _followed(chain, levels, asked, lag, progress)
    for query, there, none in answers:
        best = there.argmax()
        found.reference[query], found.unknown[query] = frames[best], none
        found.score[query] = there[first[best] : end[best]].sum(dtype=float)
    progress(len(queries))
    return found.of(np.searchsorted(asked, np.arange(len(queries)), "right") - 1)


def moving(features: Array, standing: float) -> NDArray[np.intp]:
    """Return the frames of a traverse (n, m) that differ from the last of them by more: a stop is one place."""
    kept = [0]
    for frame in range(1, len(features)):
        if np.linalg.norm(features[frame] - features[kept[-1]]) > standing:
            kept.append(frame)
    return np.array(kept)


def alike(references: Array, cosine: float) -> int:
    """Return over how many frames the mean cosine of references (n, m) falls below one, at least 1."""
    for step in range(1, len(references)):
        if np.einsum("ij,ij->i", references[step:], references[:-step]).mean() < cosine:
            return step
    return max(len(references) - 1, 1)


def _levels(references: Array, queries: Array, known: NDArray[np.intp], asked: NDArray[np.intp]) -> Levels:
    """Return how far queries stand out at references, for those that are asked and known."""
    levels = np.empty((len(asked), len(known)), np.uint16)

    def fill(start: int) -> None:
        z = (queries[asked[start : start + _BLOCK]] @ references.T)[:, known]
        for row, level in zip(z, levels[start : start + _BLOCK], strict=True):
            row[:] = over(row, float(row.mean()), float(row.std()))
            place = np.rint((row - np.float32(GRID[0])) * np.float32(1.0 / (_LEVELS[1] - _LEVELS[0])))
            level[:] = np.clip(place, 0, _LEVELS.size - 1) if row.any() else _SILENT

    for _ in in_parallel(fill, range(0, len(asked), _BLOCK)):
        pass
    return levels


def _learned(chain: Chain, levels: Levels, progress: Progress = ignore) -> Evidence:
    """Return the evidence of queries (q, n), learned from a part of them if they are many."""
    count = min(_STRETCHES, -(-len(levels) // _STRETCH))
    whole = len(levels) <= count * _STRETCH
    starts = [0] if whole else np.linspace(0, len(levels) - _STRETCH, count).astype(int).tolist()
    stretches = [levels[start : len(levels) if whole else start + _STRETCH] for start in starts]
    evidence, every = Evidence(), np.concatenate(stretches)
    for done in range(1, _ROUNDS):
        answered = in_parallel(partial(_there, chain, evidence), stretches)
        evidence = Evidence.learn(every, np.concatenate(list(answered)))
        progress(len(levels) * done // _ROUNDS)
    return evidence


def _there(chain: Chain, evidence: Evidence, levels: Levels) -> Array:
    """Return the probabilities (q, n) of a stretch."""
    return np.array([there for _, there, _ in smoothed(chain, levels, evidence.of)][::-1])


def _followed(chain: Chain, levels: Levels, frames: NDArray[np.intp], lag: int, progress: Progress) -> Iterator[Answer]:
    """Yield the probabilities of each query (q, n) by those up to `lag` frames after it, learning again meanwhile."""
    recent = deque[tuple[int, Array, Array]]()

    def oldest() -> Answer:
        message = np.ones_like(belief)
        for _, _, ratios in list(recent)[:0:-1]:
            message = chain.back(chain.seen(message, ratios))
        query, then, _ = recent.popleft()
        progress(int(frames[query]) + 1)
        return query, *chain.at_references(then * message)

    evidence, belief = Evidence(), chain.first()
    for query, row in enumerate(levels):
        if query.bit_count() == 1:
            evidence = _learned(chain, levels[:query])
        while recent and frames[query] - frames[recent[0][0]] > lag:
            yield oldest()
        ratios = evidence.of(row)
        belief = chain.seen(chain.ahead(belief) if query else belief, ratios)
        recent.append((query, belief, ratios))
    while recent:
        yield oldest()


def _normal(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(np.exp(-0.5 * np.square(z)), 1e-300)
