"""Whether scores are what they say: how often answers are right, and whether unknown places are known as such."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from smal.arrays import Floats, Int64s
from smal.evaluation.ground_truth import Judgement

_BINS: Final = 10


@dataclass(frozen=True, eq=False)
class Reliability:
    """Answers by their scores, probabilities, in tenths that have any (k,): mean score, share that is right, number."""

    said: Floats
    right: Floats
    count: Int64s

    @classmethod
    def of(cls, judgement: Judgement) -> Self:
        """Take the answers to judged queries."""
        asked = judgement.judged & judgement.answered
        score = judgement.score[asked]
        right = judgement.right[asked]
        tenth = np.minimum((score * _BINS).astype(np.int64), _BINS - 1)
        count = np.bincount(tenth, minlength=_BINS)
        some = count > 0
        said, true = (np.bincount(tenth, of, _BINS)[some] / count[some] for of in (score, right))
        return cls(said, true, count[some])

    @property
    def error(self) -> float:
        """The expected calibration error: how far scores are off the share that is right, in the mean; 0 of none."""
        return float(self.count @ np.abs(self.said - self.right)) / max(int(self.count.sum()), 1)


def known_from_unknown(judgement: Judgement, sure: Floats) -> float | None:
    """Return how well sureness (q,) tells what can be found: area under the ROC curve; None if not both are there."""
    known = sure[judgement.findable]
    unknown = np.sort(sure[judgement.judged & ~judgement.findable])
    if not (known.size and unknown.size):
        return None
    below = np.searchsorted(unknown, known, "left") + np.searchsorted(unknown, known, "right")
    return float(below.mean() / (2.0 * unknown.size))
