"""Precision and recall as in the paper's experiments: a threshold sweeps the scores, and what reaches it is answered.

precision = right answers / answers,  recall = right answers / queries that have anything to find.
"""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np

from smal.arrays import Floats, Int64s
from smal.evaluation.ground_truth import Judgement

_FEWEST_BLOCKS = 4  # The bootstrap draws from at least so many blocks: of fewer it learns nothing.


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision over recall (k,), a point for each score by falling thresholds; answers reach the threshold."""

    recall: Floats
    precision: Floats
    threshold: Floats

    @classmethod
    def of(cls, judgement: Judgement, times: Int64s | None = None) -> Self:
        """Return the curve of a method's answers; ValueError when no query has anything to find.

        Queries that are not judged do not count; of the others each counts once, or as often as `times` (q,) says. An
        answer to one that has nothing to find is wrong.
        """
        times = judgement.judged.astype(np.int64) if times is None else times * judgement.judged
        to_find = int(times[judgement.findable].sum())
        if not to_find:
            raise ValueError("no query has anything to find: recall means nothing")
        order = np.flatnonzero(judgement.answered & (times > 0))
        order = order[np.argsort(-judgement.score[order], kind="stable")]
        ends = np.flatnonzero(np.diff(judgement.score[order], append=-np.inf))
        right = np.cumsum((times * judgement.right)[order])[ends]
        return cls(
            right / to_find, right / np.cumsum(times[order])[ends], judgement.score[order][ends]
        )

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


def intervals_of(figures: Floats) -> Intervals:
    """Return the intervals between which the middle 95 % of the figures of `bootstrap` lie.

    Few blocks make them too narrow. Recall at 100 % precision is decided by the surest wrong answer, which a third of
    the draws lack: its interval covered the median of other draws in 61 to 71 % (that of the area in 93 %).
    """
    auc, recall = np.nanpercentile(figures, (2.5, 97.5), axis=0).T.tolist()
    return Intervals((auc[0], auc[1]), (recall[0], recall[1]))


def bootstrap(judgement: Judgement, block: int, *, resamples: int = 1000, seed: int = 0) -> Floats:
    """Return area and recall at 100 % precision for other draws of the queries, float64 (resamples, 2).

    Successive queries see nearly the same: blocks of them are drawn (`block_length`), the last followed by the first
    (Politis & Romano 1992). The same seed, block and judged queries give the same draws, so that differences of methods
    are paired. NaN where a draw has nothing to find; ValueError as of `PrecisionRecall.of`.
    """
    PrecisionRecall.of(judgement)
    judged = np.flatnonzero(judgement.judged)
    # In the order of their scores, so that no draw has to be sorted.
    order = np.argsort(-judgement.score, kind="stable")
    ordered = Judgement(*(getattr(judgement, part.name)[order] for part in fields(judgement)))
    figures = np.full((resamples, 2), np.nan)
    starts = np.random.default_rng(seed).integers(
        0, judged.size, (resamples, -(-judged.size // block), 1)
    )
    for row, begins in zip(figures, starts, strict=True):
        drawn = judged[((begins + np.arange(block)) % judged.size).ravel()[: judged.size]]
        if judgement.findable[drawn].any():
            curve = PrecisionRecall.of(ordered, np.bincount(drawn, minlength=order.size)[order])
            row[:] = curve.auc, curve.recall_at_100_precision
    return figures


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a success rate, 0 <= successes <= runs, runs >= 1; ValueError for others."""
    from scipy.stats import binomtest  # noqa: PLC0415 - takes a second to load, and few need it

    low, high = binomtest(successes, runs).proportion_ci(method="wilson")
    return float(low), float(high)
