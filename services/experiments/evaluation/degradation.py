"""Degradations of camera images; random by seed and tick, so that all methods see the same."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Smallest share of the image that an occluder covers; the largest is the whole image.
LEAST_COVERED: Final = 0.5
# Random sources of an episode; their order is part of every seed.
_WHETHER, _WHAT, _NOISE = range(3)


@dataclass(frozen=True)
class Degradation:
    """Degradation of the robot's view."""

    # Share of frames with a rectangle of one colour over 50 to 100 % of the image.
    occlusion: float = 0.0
    # Standard deviation of Gaussian noise on every pixel and channel, grey levels.
    noise: float = 0.0
    shake: float | None = None  # Strength of the camera shake; None for the world's default.

    @property
    def meaning(self) -> str:
        """Description in one line."""
        said = [
            f"{self.occlusion:.0%} of the frames occluded by half or more"
            if self.occlusion
            else "",
            f"noise of {self.noise:g} grey levels" if self.noise else "",
            "" if self.shake is None else f"shake {self.shake:g}",
        ]
        return ", ".join(filter(None, said)) or "same as in teaching"


DEGRADATIONS: Final = {
    "clean": Degradation(),
    "occluded": Degradation(occlusion=0.35),
    #: All degradations at once.
    "poor": Degradation(occlusion=0.35, noise=40.0, shake=2.0),
}


class Degrader:
    """Degrades the frames of one episode, in order from tick 0; the simulator adds the shake."""

    def __init__(self, degradation: Degradation, seed: int) -> None:
        self._degradation = degradation
        self._seed = seed
        self._whether = np.random.default_rng([seed, _WHETHER])

    def apply(self, tick: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a degraded copy of an image, (height, width, 3) uint8 RGB."""
        how = self._degradation
        if how.occlusion and self._whether.random() < how.occlusion:
            image = _occluded(image, np.random.default_rng([self._seed, _WHAT, tick]))
        if how.noise:
            rng = np.random.default_rng([self._seed, _NOISE, tick])
            noise = how.noise * rng.standard_normal(image.shape, dtype=np.float32)
            image = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
        return image


def _occluded(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Hide a random rectangle of at least `LEAST_COVERED` of the image behind one colour."""
    height, width = image.shape[:2]
    covered = rng.uniform(LEAST_COVERED, 1.0)
    across = rng.uniform(covered, 1.0)
    columns = min(width, math.ceil(across * width))
    rows = min(height, math.ceil(covered / across * height))
    left = rng.integers(0, width - columns + 1)
    top = rng.integers(0, height - rows + 1)
    hidden = image.copy()
    hidden[top : top + rows, left : left + columns] = rng.integers(0, 256, 3, dtype=np.uint8)
    return hidden
