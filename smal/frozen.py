"""Detection of a frozen camera: pictures must change while the wheels move."""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.map import VisualMap
from smal.movement import placed

#: Share of the change that the map predicts from one keyframe to the next. The noise of a camera changes less.
CHANGES: Final = 0.1
#: Change since a keyframe before, in mean changes from frame to frame. Noise does not grow with the way: 1. The picture
#: of a lawn before far houses changes slowly, but with every frame: 2.4.
GROWS: Final = 1.5


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
        self._last: Float32s | None = None
        self.yes = False

    def _begin_at(self, centred: Float32s) -> None:
        """Compare the next pictures with this one."""
        self._before = self._last = centred
        self._since = np.zeros(3)
        self._driven = 0.0
        self._frames = 0
        self._changes = 0.0  # Sum of the changes from frame to frame.

    @property
    def way(self) -> float:
        """Way since the last change of the picture, in the map's unit; 0 if the camera is not frozen."""
        return self._driven if self.yes else 0.0

    def observe(self, centred: Float32s, step: AnyArray) -> None:
        """Process the centred features (m,) of a picture, and the movement (3,) since the picture before."""
        if self._last is None:
            self._begin_at(centred)
            return
        self._since = placed(step, self._since)
        self._driven += abs(float(step[0]))
        self._frames += 1
        self._changes += self._change(centred, self._last)
        self._last = centred
        expected = self._map.expected(self._since)
        if expected >= self._map.next_correlation:
            # The robot has hardly moved: an unchanged picture is correct.
            return
        change = self._change(centred, self._before)
        noise = self._changes / self._frames
        self.yes = change < CHANGES * (1.0 - expected) and change <= GROWS * noise
        if not self.yes:
            self._begin_at(centred)

    def _change(self, picture: Float32s, other: Float32s) -> float:
        return 1.0 - self._map.likelihood.correlation(float(picture @ other))
