"""Reliability of scores: the calibration of answers, and the detection of unknown places."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from smal.arrays import Floats, Int64s
from smal.evaluation.ground_truth import Judgement

_BINS: Final = 10


@dataclass(frozen=True, eq=False)
class Reliability:
    """Answers in tenths of the score, without empty ones (k,): mean score, share of right answers, number."""

    said: Floats
    right: Floats
    count: Int64s

    @classmethod
    def of(cls, judgement: Judgement) -> Self:
        """Count the answers to judged queries."""
        asked = judgement.judged & judgement.answered
        score = judgement.score[asked]
        right = judgement.right[asked]
        tenth = np.minimum((score * _BINS).astype(np.int64), _BINS - 1)
        count = np.bincount(tenth, minlength=_BINS)
        full = count > 0
        count = count[full]
        mean_score = np.bincount(tenth, score, _BINS)[full] / count
        share_right = np.bincount(tenth, right, _BINS)[full] / count
        return cls(mean_score, share_right, count)

    @property
    def error(self) -> float:
        """The expected calibration error: mean difference of scores from the share of right answers; 0 if empty."""
        off = np.abs(self.said - self.right)
        return float(self.count @ off) / max(int(self.count.sum()), 1)


def known_from_unknown(judgement: Judgement, sure: Floats) -> float | None:
    """Return the area under the ROC curve of confidences (q,) for findable queries; None without both kinds."""
    known = sure[judgement.findable]
    unknown = np.sort(sure[judgement.judged & ~judgement.findable])
    if not (known.size and unknown.size):
        return None
    below = np.searchsorted(unknown, known, "left") + np.searchsorted(unknown, known, "right")
    return float(below.mean() / (2.0 * unknown.size))
