"""Choosing tau: from which score on the answers are right."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall

#: How far below the least score tau lies where no answer is to be left out, as a share of that score.
_BELOW = 0.05


@dataclass(frozen=True)
class Threshold:
    """A threshold, and what it gave where it was chosen.

    Parameters
    ----------
    tau : float
        Answers with a score above it are given (`Matches.above`, and Eq. 8).
    precision, recall : float
        In [0, 1].
    """

    tau: float
    precision: float
    recall: float


@dataclass(frozen=True)
class Answers:
    """How many answers a threshold gives.

    Parameters
    ----------
    given, right : int
    findable : int
        Queries that have anything to find.
    """

    given: int
    right: int
    findable: int


def choose_threshold(judgement: Judgement, precision: float) -> Threshold | None:
    """Return the least threshold with at least this precision, so that recall is the largest.

    It lies between the least score that is kept and the next lower one, and has as few decimals as fit there.

    Parameters
    ----------
    judgement : Judgement
    precision : float
        Above 0, at most 1: with 1, all answers that are given are right.

    Returns
    -------
    Threshold or None
        None where no threshold reaches that precision.

    Raises
    ------
    ValueError
        The precision is out of its range, or no query has anything to find.
    """
    if not 0.0 < precision <= 1.0:
        raise ValueError(f"a precision lies above 0 and at most at 1, got {precision}")
    curve = PrecisionRecall.of(judgement)
    reaching = np.flatnonzero((curve.precision >= precision) & (curve.recall > 0.0))
    if not reaching.size:
        return None
    last = int(reaching[-1])
    kept = float(curve.threshold[last])
    is_least = last + 1 == curve.threshold.size
    left_out = kept - _BELOW * abs(kept) if is_least else float(curve.threshold[last + 1])
    tau = _shortest_decimal(left_out, kept)
    return Threshold(tau, float(curve.precision[last]), float(curve.recall[last]))


def count_answers(judgement: Judgement, tau: float) -> Answers:
    """Count the answers with a score above tau."""
    given = judgement.judged & judgement.answered & (judgement.score > tau)
    return Answers(int(given.sum()), int((given & judgement.right).sum()), int(judgement.findable.sum()))


def pooled(judgements: Sequence[Judgement]) -> Judgement:
    """Join the judgements of several trials of one method and setting, whose scores can be compared."""
    names = ("score", "answered", "right", "judged", "findable")
    return Judgement(*(np.concatenate([getattr(one, name) for one in judgements]) for name in names))


def _shortest_decimal(least: float, above: float) -> float:
    """Return a number with few decimals in [least, above), near the middle."""
    middle = least + (above - least) / 2
    for digits in range(1, 17):
        rounded = float(f"{middle:.{digits}g}")
        if least <= rounded < above:
            return rounded
    return middle if middle < above else math.nextafter(above, -math.inf)
