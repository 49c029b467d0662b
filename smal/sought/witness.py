"""Probability that the target is in view, over successive frames, from its appearance and its detections."""

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from smal.camera import Image
from smal.features.detectors import Detection
from smal.sought.score import Said
from smal.sought.sight import TARGET_CONFIG, Sight
from smal.sought.word import Word


class Glimpse(NamedTuple):
    """Estimate for one view."""

    #: Probability that the target is in view.
    probability: float
    #: Distance to the target where the taught ways ended, over the distance now; 0 out of view.
    near: float
    #: Left of the middle of the view, as a share of its width, -0.5 to 0.5; None out of view.
    left: float | None = None


class Witness:
    """Estimates for each view whether the target is in view, by its appearance, its detections, or both."""

    def __init__(self, sight: Sight | None, word: Word | None = None) -> None:
        self._sight = sight
        self._word = word
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._said = deque[tuple[float, Said]]()

    def look(
        self, picture: Image, time_s: float = 0.0, detected: Iterable[Detection] = ()
    ) -> Glimpse:
        """Process a small picture at a time in ascending order. A hidden view gives no evidence."""
        said = self._says(picture, detected)
        near = 0.0
        left = None
        if said is not None:
            self._said.append((time_s, said))
            while self._said[0][0] < time_s - 0.99 * TARGET_CONFIG.same_moment_s:
                self._said.popleft()
            near = float(np.mean([recent.near for _, recent in self._said]))
            left = said.left if said.log_ratio > 0.0 else None
        # Views of one moment are not independent: together they count as one.
        mean = 0.0
        if self._said:
            mean = float(np.mean([recent.log_ratio for _, recent in self._said]))
        prior = TARGET_CONFIG.in_view / (1.0 - TARGET_CONFIG.in_view)
        odds = prior * math.exp(min(mean, 50.0))
        return Glimpse(odds / (1.0 + odds), near, left)

    def _says(self, picture: Image, detected: Iterable[Detection]) -> Said | None:
        """Return the joint evidence: log ratios add up, and the stronger evidence gives the position."""
        if self._sight is None:
            patch = None if float(picture.std()) < TARGET_CONFIG.plain else Said(0.0, 0.0, 0.0)
        else:
            patch = self._sight.says(picture)
        if patch is None or self._word is None:
            return patch
        word = self._word.says(detected)
        return max(patch, word)._replace(log_ratio=patch.log_ratio + word.log_ratio)
