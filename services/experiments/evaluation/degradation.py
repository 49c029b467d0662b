"""Degradations of what a running robot sees; chance belongs to seed and tick, so that all methods see the same."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

LEAST_COVERED: Final = (
    0.5  # Share of the image that an occluder covers, at least; at most all of it.
)
_WHETHER, _WHAT, _NOISE = range(
    3
)  # Sources of chance in an episode; their order is part of every seed.


@dataclass(frozen=True)
class Degradation:
    """How bad the robot's view is."""

    occlusion: float = (
        0.0  # Share of the frames of which one colour hides 50 to 100 %, a rectangle.
    )
    noise: float = (
        0.0  # Standard deviation of Gaussian noise on every pixel and channel, grey levels.
    )
    shake: float | None = None  # Strength of the camera's shake; None for as usual in that world.

    @property
    def meaning(self) -> str:
        """One line for people."""
        said = [
            f"{self.occlusion:.0%} of the frames occluded by half or more"
            if self.occlusion
            else "",
            f"noise of {self.noise:g} grey levels" if self.noise else "",
            "" if self.shake is None else f"shake {self.shake:g}",
        ]
        return ", ".join(filter(None, said)) or "as in teaching"


DEGRADATIONS: Final = {
    "clean": Degradation(),
    "occluded": Degradation(occlusion=0.35),
    #: All that a camera suffers at once.
    "poor": Degradation(occlusion=0.35, noise=40.0, shake=2.0),
}


class Degrader:
    """Degrades the frames of one episode, in order from tick 0; its shake is the simulation's matter."""

    def __init__(self, degradation: Degradation, seed: int) -> None:
        self._degradation = degradation
        self._seed = seed
        self._whether = np.random.default_rng([seed, _WHETHER])

    def apply(self, tick: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what the robot sees of a frame, (height, width, 3) uint8 RGB; the given image stays as it is."""
        how = self._degradation
        if how.occlusion and self._whether.random() < how.occlusion:
            image = _occluded(image, np.random.default_rng([self._seed, _WHAT, tick]))
        if how.noise:
            rng = np.random.default_rng([self._seed, _NOISE, tick])
            noise = how.noise * rng.standard_normal(image.shape, dtype=np.float32)
            image = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
        return image


def _occluded(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Hide a rectangle that covers at least `LEAST_COVERED` of the image, anywhere in it, behind one colour."""
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
