"""Evidence of a score for the target, calibrated on the taught views.

A robot can search in another light, so only the order of the scores elsewhere is taught, not their
exact distribution. Scores elsewhere have an exponential tail that reaches the way's own maximum
once in all its views. Scores in view are any share of the score where the ways ended: viewpoint,
light and occlusion reduce it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

#: Scatter of scores elsewhere in another light, over the scatter on the taught day.
_OTHER_LIGHT: Final = 2.0
#: Minimum scatter elsewhere, as a share of the score of the target: fewer views than that are taught.
_LEAST_SCATTER: Final = 0.05


class Sighting(NamedTuple):
    """Evidence of one picture for the target."""

    #: Log p(picture | target in view) - log p(picture | not in view).
    log_ratio: float
    #: Log of the distance where the taught ways ended, over the distance now.
    log_near: float
    #: Standard deviation of `log_near`.
    error: float
    #: Left of the middle of the picture, as a share of the width, -0.5 to 0.5.
    left: float
    #: Whether the border cuts the target, so that it can be nearer than `log_near`.
    cut: bool = False


#: Picture without the target.
NOTHING: Final = Sighting(0.0, 0.0, 1e3, 0.0)


@dataclass(frozen=True)
class ScoreEvidence:
    """Calibration of a score."""

    #: Median score of the way without the target.
    usual: float
    #: Largest score of the way without the target.
    most: float
    #: Score of the target where the ways ended.
    best: float
    #: Number of views of the way.
    views: int

    def __post_init__(self) -> None:
        """Raise ValueError if the numbers do not fit together: they can come from a file."""
        numbers = self.usual, self.most, self.best, self.views
        if not (all(map(math.isfinite, numbers)) and self.usual < self.most and self.views > 0):
            raise ValueError("the parts of the target do not fit together: evidence")
        if not self.usual < self.best < 1e3:
            raise ValueError("the parts of the target do not fit together: best")

    @classmethod
    def fit(
        cls, here: Sequence[float], elsewhere: Sequence[float], sure: float
    ) -> "ScoreEvidence | None":
        """Calibrate on scores of the last views, and of the way.

        Returns None if a view like the last ones is not recognised with the probability `sure`.
        """
        if not len(here) or not len(elsewhere):
            return None
        best = float(np.max(here))
        usual = float(np.median(elsewhere))
        if best <= usual:
            return None
        most = max(float(np.max(elsewhere)), usual + _LEAST_SCATTER * (best - usual))
        found = cls(usual, most, best, len(elsewhere))
        return found if found.log_ratio(best) > math.log(sure / (1.0 - sure)) else None

    def log_ratio(self, score: float, noise: float = 0.0) -> float:
        """Return the log likelihood ratio of a score.

        Parameters
        ----------
        score : float
        noise : float
            Share of the distances in this view that is due to noise, 0 to 1. That share of the score
            is no evidence.
        """
        scatter = self.most - self.usual
        rate = math.log1p(self.views) / _OTHER_LIGHT
        beyond = max((1.0 - noise) * score - self.usual, 0.0) / scatter
        return rate * beyond - math.log(rate * max((self.best - self.usual) / scatter, 1.0))
