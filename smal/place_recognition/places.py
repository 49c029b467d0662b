"""The method on two traverses: where the queries are among the references, and how probable that is.

A query stands out at a reference by z: its cosine less the mean of those with all references, over their spread.
Elsewhere z is about normal. Nobody has taught how far the right place stands out in this light: the mean and the spread
there are learned from the queries themselves, without labels (expectation-maximization), and so is how much of each
query is new.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.likelihood import GRID, log_ratio, over
from smal.place_recognition.hidden_markov import Array, Chain, smoothed
from smal.place_recognition.matches import Matches, Progress, check_features, ignore

#: Mean and spread of z at the right place, and correlation of successive queries, before anything is learned; and as
#: many queries as that counts.
_MEAN, _SPREAD, _CORRELATION, _PRIOR_QUERIES = 2.0, 1.5, 1.0 / 3.0, 5
#: Least spread, and most correlation (more comes of stretches that are not at the believed place); the most that one
#: query says (log ratio).
_LEAST_SPREAD, _MOST_CORRELATION, _MOST_SAID = 0.3, 0.7, 30.0
_ROUNDS: Final = 6
#: Ratios are looked up at so many z between two of the `GRID`.
_FINE: Final = 16
#: A step shorter than this share of one in moving is one of standing still.
_STANDING: Final = 0.4


class Evidence:
    """The likelihood ratio of a query, here against elsewhere, for each z, of the part of the query that is new."""

    def __init__(self, mean: float = _MEAN, spread: float = _SPREAD, correlation: float = _CORRELATION) -> None:
        ratio = log_ratio(_normal((GRID - mean) / spread) / spread, _normal(GRID))
        new = (1.0 - correlation) / (1.0 + correlation)
        fine = np.linspace(GRID[0], GRID[-1], _FINE * (GRID.size - 1) + 1)
        said = np.clip(new * np.interp(fine, GRID, ratio), -_MOST_SAID, _MOST_SAID)
        self._ratio, self._step = np.exp(said).astype(np.float32), np.float32(fine[1] - fine[0])

    @classmethod
    def learn(cls, z: Array, there: Array) -> "Evidence":
        """Measure it on queries (q, n) that are believed to show references with probabilities (q, n)."""
        prior, believed, total = _PRIOR_QUERIES, float(there.sum(dtype=np.float64)), float(np.einsum("ij,ij", there, z))
        mean = (total + prior * _MEAN) / (believed + prior)
        scatter = float(np.einsum("ij,ij,ij", there, z, z)) - 2.0 * mean * total + believed * mean**2
        spread = max(math.sqrt(max(scatter + prior * _SPREAD**2, 0.0) / (believed + prior)), _LEAST_SPREAD)
        off, usual = z[np.arange(len(z)), there.argmax(axis=1)] - mean, prior * spread**2
        correlation = float(off[1:] @ off[:-1] + _CORRELATION * usual) / float(off @ off + usual)
        return cls(mean, spread, min(max(correlation, 0.0), _MOST_CORRELATION))

    def of(self, z: Array) -> Array:
        """Return the likelihood ratio of each z of queries (..., n); a blank one says nothing."""
        place = ((z - np.float32(GRID[0])) / self._step + np.float32(0.5)).astype(np.int32)
        return np.where(z.any(axis=-1, keepdims=True), self._ratio.take(place, mode="clip"), np.float32(1.0))


def match_places(
    references: Array, queries: Array, tolerance: int | None = None, lag: int | None = None, progress: Progress = ignore
) -> Matches:
    """Match every query with the reference that it most probably shows.

    Parameters
    ----------
    references, queries : float32 arrays (n, m), (q, m)
        At least one of each, in order, centred and weighted (`smal.place_recognition.traverse_centering`).
    tolerance : int, optional
        References so many frames away are right as well; None for those that look alike (`looks_alike`).
    lag : int, optional
        Answer each query by the queries up to so many after it; by all of them if None.
    progress : callable
        Called with the number of queries that are done.

    Returns
    -------
    Matches
        One for every query. The score is the probability that the reference is right within the tolerance.

    Raises
    ------
    ValueError
        The features do not fit each other or are not finite.
    """
    check_features(references, queries)
    steps = np.linalg.norm(np.diff(references, axis=0), axis=1)
    standing = _STANDING * float(np.quantile(steps, 0.75)) if steps.size else 0.0
    known, asked = moving(references, standing), moving(queries, standing)
    places = references[known]
    tolerance = looks_alike(places) if tolerance is None else tolerance
    z = queries[asked] @ places.T
    for row in z:
        row[:] = over(row, float(row.mean()), float(row.std()))
    chain, there, none = Chain(len(known)), np.empty_like(z), np.empty(len(z), np.float32)
    if lag is None:
        _, there, none = _learned(chain, z, progress)
    else:
        for query, answer in enumerate(_followed(chain, z, asked, lag)):
            there[query], none[query] = answer
            progress(int(asked[query]) + 1)
    progress(len(queries))
    # The middle of each stop.
    frames = (known + np.append(known[1:], len(references)) - 1) // 2
    found = frames[there.argmax(axis=1)]
    first, end = np.searchsorted(frames, found - tolerance), np.searchsorted(frames, found + tolerance, "right")
    score = np.array([row[some].sum(dtype=float) for row, some in zip(there, map(slice, first, end), strict=True)])
    every = np.searchsorted(asked, np.arange(len(queries)), "right") - 1
    return Matches(found, score, none.astype(np.float64)).of(every)


def moving(features: Array, standing: float) -> NDArray[np.intp]:
    """Return the frames of a traverse (n, m) that differ from the last of them by more: a stop is one place."""
    kept = [0]
    for frame in range(1, len(features)):
        if np.linalg.norm(features[frame] - features[kept[-1]]) > standing:
            kept.append(frame)
    return np.array(kept)


def looks_alike(references: Array) -> int:
    """Return over how many frames the mean cosine of references (n, m) falls to half, at least 1."""
    for step in range(1, len(references)):
        if np.einsum("ij,ij->i", references[step:], references[:-step]).mean() < 0.5:
            return step
    return 1


def _learned(chain: Chain, z: Array, progress: Progress = ignore) -> tuple[Evidence, Array, Array]:
    """Return the evidence of queries (q, n), and the probabilities of `smoothed` by which it was learned."""
    evidence = Evidence()
    there, none = smoothed(chain, z, evidence.of)
    for done in range(1, _ROUNDS):
        progress(len(z) * done // _ROUNDS)
        evidence = Evidence.learn(z, there)
        there, none = smoothed(chain, z, evidence.of)
    return evidence, there, none


def _followed(chain: Chain, z: Array, frames: NDArray[np.intp], lag: int) -> Iterator[tuple[Array, float]]:
    """Yield the probabilities of each query (q, n) by those up to `lag` frames (q,) after it.

    Whenever there are twice as many queries as before, what they say is learned again.
    """
    recent = deque[tuple[int, Array, Array]]()

    def oldest() -> tuple[Array, float]:
        message = np.ones_like(belief)
        for _, _, ratios in list(recent)[:0:-1]:
            message = chain.back(chain.seen(message, ratios))
        return chain.at_references(recent.popleft()[1] * message)

    evidence, belief = Evidence(), chain.first()
    for query, row in enumerate(z):
        if query.bit_count() == 1:
            evidence = _learned(chain, z[:query])[0]
        while recent and frames[query] - recent[0][0] > lag:
            yield oldest()
        ratios = evidence.of(row)
        belief = chain.seen(chain.ahead(belief) if query else belief, ratios)
        recent.append((int(frames[query]), belief, ratios))
    while recent:
        yield oldest()


def _normal(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(np.exp(-0.5 * np.square(z)), 1e-300)
