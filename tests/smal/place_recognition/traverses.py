"""Two traverses of one made-up road, for the tests of methods."""

import numpy as np
from numpy.typing import NDArray


def random_features(rng: np.random.Generator, count: int, size: int = 24) -> NDArray[np.float32]:
    """Return features (count, size) of frames that have nothing to do with each other, of length 1."""
    features = rng.normal(size=(count, size))
    return np.asarray(features / np.linalg.norm(features, axis=1, keepdims=True), dtype=np.float32)


class Road:
    """Features that change smoothly along a road and never come again: waves of random length in every entry."""

    def __init__(self, rng: np.random.Generator, size: int = 64) -> None:
        self._frequency = rng.normal(scale=0.5, size=size)
        self._phase = rng.uniform(0, 2 * np.pi, size)

    def at(self, positions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the features (n, size) at positions (n,), in reference frames from the start."""
        return np.asarray(np.cos(np.outer(positions, self._frequency) + self._phase), dtype=np.float32)
