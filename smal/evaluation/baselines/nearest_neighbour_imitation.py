"""Nearest-neighbour imitation: find the demonstrated moment that looks most alike, and do what was done then.

The plainest way to use demonstrations: no states, no reward, no plan. It sees the same features as SMAL.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Demonstration
from smal.features import Centering, FeatureSettings, extract
from smal.movement import Atom


class NearestNeighbourImitation:
    """Imitates the demonstrated frame whose window differs least from the last frames.

    The distance of a query window y to the window of a demonstration that ends at its frame t is

        d(t) = sum_{k=0}^{f-1} || y_{-k} - x_{t-k} ||^2

    over the last f frames, or as many as there are in the episode so far. Windows never span two demonstrations. The
    atom that was executed after the frame of the least distance is executed; of equal ones the earliest counts.

    All demonstrations have features by the settings; f is ``frames``.
    """

    def __init__(self, demonstrations: Sequence[Demonstration], settings: FeatureSettings, frames: int = 1) -> None:
        if not demonstrations:
            raise ValueError("there is no demonstration to imitate")
        if frames < 1:
            raise ValueError(f"frames must be at least 1, got {frames}")
        self._settings, self._frames = settings, frames
        raw = [one.features for one in demonstrations]
        self._centering = Centering.fit(raw, settings)
        self._templates = np.concatenate([self._centering.apply(each) for each in raw])
        self._squares = np.square(self._templates).sum(axis=1)
        self._atoms = np.concatenate([one.atoms for one in demonstrations])
        # How many frames of the same demonstration are before each.
        self._before = np.concatenate([np.arange(len(each)) for each in raw])
        self.reset()

    def reset(self) -> None:
        """Forget all frames, for a new episode."""
        self._distances: list[NDArray[np.float32]] = []

    def nearest(self, raw_features: NDArray[np.float32]) -> int:
        """Take one frame (m,), and return the nearest template frame, counted over all demonstrations in order."""
        query = self._centering.apply(raw_features)
        distances = self._squares - 2.0 * (self._templates @ query) + query @ query
        self._distances = [distances, *self._distances[: self._frames - 1]]
        total = distances.astype(np.float64)
        for back, earlier in enumerate(self._distances[1:], 1):
            total[back:] += earlier[:-back]
        # An episode may last longer than every demonstration, so that some are long enough whatever f is.
        needed = min(len(self._distances) - 1, int(self._before.max()))
        return int(np.where(self._before >= needed, total, np.inf).argmin())

    def step(self, image: NDArray[np.uint8], odometry: Sequence[float] | None = None) -> Atom:
        """Take one image, (height, width, 3) RGB, and return what to do; the wheels do not count."""
        del odometry
        return Atom(int(self._atoms[self.nearest(extract(image, self._settings))]))
