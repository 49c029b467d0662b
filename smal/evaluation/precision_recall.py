"""Precision and recall as in the paper's experiments: a threshold sweeps the scores, and what reaches it is answered.

precision = right answers / answers,  recall = right answers / queries that have anything to find.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from smal.evaluation.ground_truth import Judgement

#: Entries of the (resamples, queries) matrix that are held at a time: 8 MB.
_BLOCK_ENTRIES = 1 << 20
#: The bootstrap draws from at least so many blocks, if there are so many queries: of fewer it learns nothing.
_FEWEST_BLOCKS = 4


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """A curve of precision over recall, arrays (k,): answers with a score of at least the threshold are given.

    One point for each different score, so that the order of queries with equal scores does not matter; no point if
    nothing is answered. Thresholds fall.
    """

    recall: NDArray[np.float64]
    precision: NDArray[np.float64]
    threshold: NDArray[np.float64]

    @classmethod
    def of(cls, judgement: Judgement) -> Self:
        """Return the curve of a method's answers; ValueError when no query has anything to find.

        Queries that are not judged do not count. A query that is judged and has nothing to find does not count for
        recall; an answer to it is wrong. A query that has something to find and no answer counts for recall.
        """
        ranking = _Ranking(judgement)
        answers, right = ranking.counts(np.ones((1, judgement.judged.sum()), dtype=np.int64))
        return cls(right[0] / ranking.findable.sum(), right[0] / answers[0], ranking.threshold)

    @property
    def auc(self) -> float:
        """Area under the curve, in [0, 1]: average precision, the sum of precision times step of recall.

        Not the trapezoid's area: between two points of such a curve precision does not run along the straight line
        but below it (Davis & Goadrich 2006), so that a method with few different scores would gain.
        """
        return float(self.precision @ np.diff(self.recall, prepend=0.0))

    @property
    def recall_at_100_precision(self) -> float:
        """The highest recall without a wrong answer, in [0, 1]; 0 where the surest answer is wrong already."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))


class Intervals(NamedTuple):
    """Bootstrap intervals (low, high) of the two figures of a curve."""

    auc: tuple[float, float]
    recall_at_100_precision: tuple[float, float]


def block_length(queries: int, length: int) -> int:
    """Return how many successive queries the bootstrap keeps together.

    Windows of `length` frames that overlap share frames, so that their errors come together; beyond that the cube
    root of the number of queries is the usual order (Künsch 1989). At most a quarter of the queries.
    """
    return max(1, min(max(length, round(math.cbrt(queries))), queries // _FEWEST_BLOCKS))


def intervals_of(figures: NDArray[np.float64]) -> Intervals:
    """Return the intervals between which the middle 95 % of the figures of `bootstrap` lie.

    They say how much the figures would vary with other queries of the same kind along the same references. Few blocks
    make them too narrow. The recall at 100 % precision is decided by the surest wrong answer, an extreme, which a
    third of the draws lack: its interval reaches upward, and covered the median of other draws in 61 to 71 % (400
    independent queries, where that of the area covered it in 93 %).
    """
    auc, recall = np.nanpercentile(figures, (2.5, 97.5), axis=0).T.tolist()
    return Intervals((auc[0], auc[1]), (recall[0], recall[1]))


def bootstrap(judgement: Judgement, block: int, *, resamples: int = 1000, seed: int = 0) -> NDArray[np.float64]:
    """Compute the figures of the curve for other draws of the queries: the circular block bootstrap.

    Successive queries, in the order of the traverse, see nearly the same, so that single ones drawn at random would
    pass for far more evidence than they are. Blocks of successive judged queries are drawn instead (`block_length`),
    the last followed by the first (Politis & Romano 1992), until there are as many queries as before. The same seed,
    block and judged queries give the same draws: differences of two methods' figures are paired.

    Returns
    -------
    float64 array (resamples, 2)
        Area and recall at 100 % precision; NaN where a draw has no query with anything to find.
    """
    ranking = _Ranking(judgement)
    parts = [ranking.figures(draws) for draws in _draws(ranking.findable.size, block, resamples, seed)]
    return np.concatenate(parts)


class _Ranking:
    """The judged queries of a method, those with an answer ordered by its score: `threshold` (k,), falling."""

    def __init__(self, judgement: Judgement) -> None:
        judged = judgement.judged
        self.findable = judgement.findable[judged]
        if not self.findable.any():
            raise ValueError("no query has anything to find: recall means nothing")
        score = judgement.score[judged]
        answered = np.flatnonzero(judgement.answered[judged])
        self._order = answered[np.argsort(-score[answered], kind="stable")]
        self._right = judgement.right[judged][self._order]
        ranked = score[self._order]
        #: Where each group of equal scores ends.
        self._ends = np.flatnonzero(np.diff(ranked, append=-np.inf))
        self.threshold = ranked[self._ends]

    def counts(self, draws: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Count the answers, and the right ones, at every threshold, (b, k), of queries drawn so many times (b, j)."""
        ranked = draws[:, self._order]
        answers = np.cumsum(ranked, axis=1)[:, self._ends]
        return answers, np.cumsum(ranked * self._right, axis=1)[:, self._ends]

    def figures(self, draws: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return area and recall at 100 % precision (b, 2) of queries drawn so many times (b, j)."""
        answers, right = self.counts(draws)
        precision = np.divide(right, answers, out=np.zeros(right.shape), where=answers > 0)
        area = (precision * np.diff(right, axis=1, prepend=0)).sum(axis=1)
        surest = np.where(answers == right, right, 0).max(axis=1, initial=0)
        with np.errstate(invalid="ignore"):
            figures: NDArray[np.float64] = np.column_stack([area, surest]) / (draws @ self.findable)[:, np.newaxis]
        return figures


def _draws(count: int, block: int, resamples: int, seed: int) -> Iterator[NDArray[np.int64]]:
    """Yield how many times each of `count` queries is drawn, (b, count), for a few resamples at a time."""
    starts = np.random.default_rng(seed).integers(0, count, (resamples, -(-count // block), 1))
    step = max(1, _BLOCK_ENTRIES // count)
    for begin in range(0, resamples, step):
        some = starts[begin : begin + step]
        queries = ((some + np.arange(block)) % count).reshape(len(some), -1)[:, :count]
        rows = count * np.arange(len(some))[:, np.newaxis]
        yield np.bincount((rows + queries).ravel(), minlength=count * len(some)).reshape(-1, count)
