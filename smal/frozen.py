"""Whether a camera still shows the world: its pictures must change while the wheels move."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from smal.map import VisualMap
from smal.movement import placed

#: Share of the change that the map lets expect. A picture that changes by less, over the way from one keyframe to the
#: next, is the same picture with the noise of its camera.
CHANGES: Final = 0.1


class Frozen:
    """Compares each picture with one before, and the change with what the movement lets expect.

    Attributes
    ----------
    yes : bool
        Whether the camera is frozen.
    """

    def __init__(self, visual_map: VisualMap) -> None:
        self._map = visual_map
        self.reset()

    def reset(self) -> None:
        """Forget everything, for a new episode."""
        self._before: NDArray[np.float32] | None = None
        self._since = np.zeros(3)
        self._driven = 0.0
        self.yes = False

    @property
    def way(self) -> float:
        """Way since the last picture that changed, in the map's unit, if the camera is frozen; else 0."""
        return self._driven if self.yes else 0.0

    def look(self, centred: NDArray[np.float32], step: NDArray[Any]) -> None:
        """Take the centred features (m,) of a picture, and the movement (3,) since the one before."""
        if self._before is None:
            self._before = centred
            return
        self._since = placed(step, self._since)
        self._driven += abs(float(step[0]))
        expected = self._map.expected(self._since)
        if expected >= self._map.next_correlation:
            return  # The robot has hardly moved: a still picture is right.
        same = self._map.likelihood.correlation(float(centred @ self._before))
        self.yes = 1.0 - same < CHANGES * (1.0 - expected)
        if not self.yes:
            self._before = centred
            self._since = np.zeros(3)
            self._driven = 0.0
