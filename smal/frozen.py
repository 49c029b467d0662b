"""Detection of a frozen camera: pictures must change while the wheels move."""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.map import VisualMap
from smal.movement import placed

#: Share of the change that the map predicts. A smaller change from one keyframe to the next is the noise of the camera:
#: the picture is the same.
CHANGES: Final = 0.1


class Frozen:
    """Compares the change of the picture with the change that the movement predicts.

    Attributes
    ----------
    yes : bool
        Whether the camera is frozen.
    """

    def __init__(self, visual_map: VisualMap) -> None:
        self._map = visual_map
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._before: Float32s | None = None
        self._since = np.zeros(3)
        self._driven = 0.0
        self.yes = False

    @property
    def way(self) -> float:
        """Way since the last change of the picture, in the map's unit; 0 if the camera is not frozen."""
        return self._driven if self.yes else 0.0

    def observe(self, centred: Float32s, step: AnyArray) -> None:
        """Process the centred features (m,) of a picture, and the movement (3,) since the picture before."""
        if self._before is None:
            self._before = centred
            return
        self._since = placed(step, self._since)
        self._driven += abs(float(step[0]))
        expected = self._map.expected(self._since)
        if expected >= self._map.next_correlation:
            # The robot has hardly moved: an unchanged picture is correct.
            return
        same = self._map.likelihood.correlation(float(centred @ self._before))
        self.yes = 1.0 - same < CHANGES * (1.0 - expected)
        if not self.yes:
            self._before = centred
            self._since = np.zeros(3)
            self._driven = 0.0
