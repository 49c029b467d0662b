"""Whether what is sought is in view, from frame to frame, by all that can say so."""

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
    """What a view says of what is sought."""

    probability: float  # Of being in view.
    near: float  # Distance from it where the taught ways ended, over the distance now; 0 where it is not in view.
    left: float | None = (
        None  # Of the middle of the view, as a share of its width, -0.5 to 0.5; none if it is hidden.
    )


class Witness:
    """Tells from view to view whether what is sought is in view, by how it looks, by a detector's word, or by both."""

    def __init__(self, sight: Sight | None, word: Word | None = None) -> None:
        self._sight = sight
        self._word = word
        self.reset()

    def reset(self) -> None:
        """Forget everything, for a new episode."""
        self._said = deque[tuple[float, Said]]()

    def look(
        self, picture: Image, time_s: float = 0.0, detected: Iterable[Detection] = ()
    ) -> Glimpse:
        """Take a small picture, seen at a time that does not fall. A view that is hidden is no evidence."""
        said = self._says(picture, detected)
        near = 0.0
        left = None
        if said is not None:
            self._said.append((time_s, said))
            while self._said[0][0] < time_s - 0.99 * TARGET_CONFIG.same_moment_s:
                self._said.popleft()
            near = float(np.mean([one.near for _, one in self._said]))
            left = said.left if said.log_ratio > 0.0 else None
        # Views of one moment are no independent witnesses: together they say what one says.
        mean = float(np.mean([one.log_ratio for _, one in self._said])) if self._said else 0.0
        odds = TARGET_CONFIG.in_view / (1.0 - TARGET_CONFIG.in_view) * math.exp(min(mean, 50.0))
        return Glimpse(odds / (1.0 + odds), near, left)

    def _says(self, picture: Image, detected: Iterable[Detection]) -> Said | None:
        """Return what both say together: their log ratios add up, and where it is tells the one that says most."""
        if self._sight is None:
            patch = None if float(picture.std()) < TARGET_CONFIG.plain else Said(0.0, 0.0, 0.0)
        else:
            patch = self._sight.says(picture)
        if patch is None or self._word is None:
            return patch
        word = self._word.says(detected)
        return max(patch, word)._replace(log_ratio=patch.log_ratio + word.log_ratio)
