"""Precision and recall as in the paper's experiments: answers are accepted by a threshold on their scores.

precision = right answers / answers,  recall = right answers / findable queries.
"""

import math
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from smal.arrays import Floats, Int64s
from smal.evaluation.ground_truth import Judgement

_FEWEST_BLOCKS = 4  # Minimum number of blocks of the bootstrap.


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall (k,), one point for each score, by falling thresholds."""

    recall: Floats
    precision: Floats
    threshold: Floats

    @classmethod
    def of(cls, judgement: Judgement, times: Int64s | None = None) -> Self:
        """Return the curve of a method's answers.

        Unjudged queries do not count. Each judged query counts once, or `times` (q,) times. An answer to a query
        without a right reference is wrong. ValueError if no query is findable.
        """
        times = judgement.judged.astype(np.int64) if times is None else times * judgement.judged
        to_find = int(times[judgement.findable].sum())
        if not to_find:
            raise ValueError("no query has anything to find: recall means nothing")
        order = np.flatnonzero(judgement.answered & (times > 0))
        order = order[np.argsort(-judgement.score[order], kind="stable")]
        score = judgement.score[order]
        ends = np.flatnonzero(np.diff(score, append=-np.inf))
        right = np.cumsum((times * judgement.right)[order])[ends]
        answers = np.cumsum(times[order])[ends]
        return cls(right / to_find, right / answers, score[ends])

    @property
    def auc(self) -> float:
        """Area under the curve, in [0, 1]: average precision, the sum of precision times step of recall.

        The trapezoidal area is biased: between two points of such a curve precision lies below the straight line (Davis
        & Goadrich 2006), so that it favours methods with few different scores.
        """
        return float(self.precision @ np.diff(self.recall, prepend=0.0))

    @property
    def recall_at_100_precision(self) -> float:
        """The highest recall without a wrong answer, in [0, 1]; 0 if the most confident answer is wrong."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))


def block_length(queries: int, length: int) -> int:
    """Return the number of successive queries in a block of the bootstrap.

    Overlapping windows of `length` frames share frames, so that their errors are correlated. Beyond that, the cube root
    of the number of queries is the usual order (Künsch 1989). A block has at most a quarter of the queries.
    """
    usual = max(length, round(math.cbrt(queries)))
    return max(1, min(usual, queries // _FEWEST_BLOCKS))


def figures_of(
    curve: PrecisionRecall, judgement: Judgement, length: int
) -> dict[str, float | tuple[float, float]]:
    """Return the area and the recall at 100 % precision with 95 % intervals, by name.

    `length` is the number of frames of a window. The intervals contain the middle 95 % of the
    draws of `bootstrap`; with few blocks they are too narrow. The most confident wrong answer
    decides recall at 100 % precision, and a third of the draws lack it: its interval covered the
    median of other draws in 61 to 71 % (of the area: 93 %).
    """
    drawn = bootstrap(judgement, block_length(int(judgement.judged.sum()), length))
    auc, recall = map(tuple, np.nanpercentile(drawn, (2.5, 97.5), axis=0).T.tolist())
    return {
        "auc": curve.auc,
        "auc_95": auc,
        "recall_at_100_precision": curve.recall_at_100_precision,
        "recall_at_100_precision_95": recall,
    }


def bootstrap(judgement: Judgement, block: int, *, resamples: int = 1000, seed: int = 0) -> Floats:
    """Return area and recall at 100 % precision for resampled queries, float64 (resamples, 2).

    Successive queries are nearly equal, so that blocks are drawn (`block_length`), in a circle (Politis & Romano 1992).
    An equal seed, block and set of judged queries gives equal draws, so that differences of methods are paired. NaN if
    a draw has no findable query; ValueError as in `PrecisionRecall.of`.
    """
    PrecisionRecall.of(judgement)
    judged = np.flatnonzero(judgement.judged)
    # Sorted by score once, so that no draw must be sorted.
    order = np.argsort(-judgement.score, kind="stable")
    ordered = Judgement(*(getattr(judgement, part.name)[order] for part in fields(judgement)))
    figures = np.full((resamples, 2), np.nan)
    blocks = -(-judged.size // block)
    starts = np.random.default_rng(seed).integers(0, judged.size, (resamples, blocks, 1))
    for row, begins in zip(figures, starts, strict=True):
        positions = (begins + np.arange(block)) % judged.size
        drawn = judged[positions.ravel()[: judged.size]]
        if judgement.findable[drawn].any():
            times = np.bincount(drawn, minlength=order.size)
            curve = PrecisionRecall.of(ordered, times[order])
            row[:] = curve.auc, curve.recall_at_100_precision
    return figures


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a success rate; ValueError unless 0 <= successes <= runs and runs >= 1."""
    from scipy.stats import binomtest  # noqa: PLC0415 - takes a second to load, and few need it

    low, high = binomtest(successes, runs).proportion_ci(method="wilson")
    return float(low), float(high)
