"""Probability that the target is in view, over successive frames, from its appearance and its detections."""

import math
from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from smal.camera import Image
from smal.features.detectors import Detection
from smal.target.appearance import TARGET_CONFIG, TargetAppearance
from smal.target.distance import combined
from smal.target.evidence import NOTHING, Sighting
from smal.target.label import TargetLabel

#: Contrast of a picture, of 255, below which it is blank: the noise of a camera in the dark.
_BLANK: Final = 4.0


class TargetEstimate(NamedTuple):
    """Estimate for one view."""

    #: Probability that the target is in view.
    probability: float
    #: Distance to the target where the taught ways ended, over the distance now; 0 out of view.
    near: float
    #: Left of the middle of the view, as a share of its width, -0.5 to 0.5; None out of view.
    left: float | None = None


class TargetDetector:
    """Estimates for each view whether the target is in view, by its appearance, its detections, or both."""

    def __init__(
        self, appearance: TargetAppearance | None, label: TargetLabel | None = None
    ) -> None:
        self._appearance = appearance
        self._label = label
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._recent = deque[tuple[float, Sighting]]()

    def observe(
        self,
        picture: Image,
        time_s: float = 0.0,
        detected: Iterable[Detection] = (),
        place: tuple[float, float] | None = None,
    ) -> TargetEstimate:
        """Process a small picture at a time in ascending order. A blank view gives no evidence.

        `place` is the robot's distance from the end of the drive, and its error, in seconds of driving.
        """
        latest = None
        if float(picture.std()) >= _BLANK:
            latest = self._evidence(picture, detected)
            self._recent.append((time_s, latest))
            while self._recent[0][0] < time_s - 0.99 * TARGET_CONFIG.moment_s:
                self._recent.popleft()
        if not self._recent:
            return TargetEstimate(0.5, 0.0)
        # Views of one moment are not independent: together they count as one.
        mean = float(np.mean([sighting.log_ratio for _, sighting in self._recent]))
        probability = 1.0 / (1.0 + math.exp(-mean))
        if latest is None or latest.log_ratio <= 0.0:
            return TargetEstimate(probability, 0.0)
        return TargetEstimate(probability, self._near(place), latest.left)

    def _near(self, place: tuple[float, float] | None) -> float:
        """Return the joint estimate of the distance from the views of this moment, and from the place.

        A target that the border cuts can be nearer than it looks. The view is then a bound, within
        which the place decides.
        """
        seen = [sighting for _, sighting in self._recent if sighting.log_ratio > 0.0]
        log_near = float(np.mean([sighting.log_near for sighting in seen]))
        if self._appearance is not None and place is not None:
            of_place = self._appearance.distance.log_near_of_place(*place)
            if seen[-1].cut:
                log_near = max(log_near, of_place[0])
            else:
                log_near, _ = combined((log_near, seen[-1].error), of_place)
        return min(math.exp(log_near), 1e3)

    def _evidence(self, picture: Image, detected: Iterable[Detection]) -> Sighting:
        """Return the joint evidence: log ratios add up, and the strongest evidence gives the direction."""
        found = [] if self._appearance is None else [self._appearance.detect(picture)]
        if self._label is not None:
            found.append(self._label.detect(detected))
        strongest = max(found, default=NOTHING)
        visible = [each for each in found if each.log_ratio > 0.0] or [strongest]
        log_near, error = combined(*((each.log_near, each.error) for each in visible))
        log_ratio = sum(each.log_ratio for each in found)
        return Sighting(log_ratio, log_near, error, strongest.left, strongest.cut)
