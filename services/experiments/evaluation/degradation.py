"""Declared degradations of what a running robot sees: occluded frames, sensor noise, blur, shake.

Teaching is never degraded: the question is what a method does with views that are worse than those it was taught.
Chance belongs to the episode's seed and the tick, so that every method sees the same damage in the same frames, as
long as it lets the episode run as long.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

#: Share of the image that an occluder covers, at least; at most all of it.
LEAST_COVERED: Final = 0.5
# Sources of chance in an episode; their order is part of every seed.
_WHETHER, _WHAT, _NOISE = range(3)


@dataclass(frozen=True)
class Degradation:
    """How bad the robot's view is.

    Parameters
    ----------
    occlusion
        Share of the frames that are occluded, 0 to below 1: a rectangle of one random colour hides 50 to 100 % of them.
    burst_ticks
        Mean number of frames for which an occluder stays, as one that walks by. None: each frame by itself, which
        makes single frames fail without hiding a place altogether.
    noise
        Standard deviation of Gaussian noise on every pixel and channel, grey levels, at least 0.
    blur_px
        Standard deviation of a Gaussian blur, in pixels of an image that is 320 wide, at least 0.
    shake
        Strength of the camera's shake, for the simulation (`open_simulation`); None for as usual in that world.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    occlusion: float = 0.0
    burst_ticks: float | None = None
    noise: float = 0.0
    blur_px: float = 0.0
    shake: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.occlusion < 1.0:
            raise ValueError(f"occlusion must be at least 0 and below 1, got {self.occlusion}")
        for name in ("noise", "blur_px", "shake"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value}")
        if self.burst_ticks is not None and not max(1.0, self._shortest_burst) <= self.burst_ticks < math.inf:
            raise ValueError(
                f"burst_ticks must be at least {max(1.0, self._shortest_burst):g} where {self.occlusion:g} of the "
                f"frames are occluded, got {self.burst_ticks}"
            )

    @property
    def _shortest_burst(self) -> float:
        """Mean length of bursts that follow each other with single clear frames between."""
        return self.occlusion / (1.0 - self.occlusion)

    @property
    def meaning(self) -> str:
        """One line for people."""
        parts = []
        if self.occlusion:
            stays = "" if self.burst_ticks is None else f" in bursts of {self.burst_ticks:g} on average"
            parts.append(f"{self.occlusion:.0%} of the frames occluded by half or more{stays}")
        if self.noise:
            parts.append(f"noise of {self.noise:g} grey levels")
        if self.blur_px:
            parts.append(f"blur of {self.blur_px:g} px")
        if self.shake is not None:
            parts.append(f"shake {self.shake:g}")
        return ", ".join(parts) or "as in teaching"


CLEAN: Final = Degradation()
DEGRADATIONS: Final[Mapping[str, Degradation]] = MappingProxyType(
    {
        "clean": CLEAN,
        "occluded": Degradation(occlusion=0.35),
        "bursts": Degradation(occlusion=0.35, burst_ticks=5.0),
        "noisy": Degradation(noise=25.0),
        "blurred": Degradation(blur_px=4.0),
        "shaken": Degradation(shake=3.0),
        "poor": Degradation(occlusion=0.35, noise=40.0, shake=2.0),
    }
)


def degradation_named(name: str) -> Degradation:
    """Return a degradation.

    Raises
    ------
    ValueError
        There is none of that name.
    """
    if name not in DEGRADATIONS:
        raise ValueError(f"unknown degradation {name!r}; known are {', '.join(DEGRADATIONS)}")
    return DEGRADATIONS[name]


class Degrader:
    """Degrades the frames of one episode, in order from tick 0.

    Parameters
    ----------
    degradation
        How. Its shake is the simulation's matter.
    seed
        Of the episode.
    """

    def __init__(self, degradation: Degradation, seed: int) -> None:
        self._degradation = degradation
        self._seed = seed
        self._bursts = np.random.default_rng([seed, _WHETHER])
        self._occluded: bool | None = None

    def apply(self, tick: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what the robot sees of a frame, (height, width, 3) uint8 RGB; the given image stays as it is."""
        how = self._degradation
        if how.blur_px:
            image = _blurred(image, how.blur_px * image.shape[1] / 320.0)
        if how.occlusion and self._is_occluded():
            image = _occluded(image, np.random.default_rng([self._seed, _WHAT, tick]))
        if how.noise:
            image = _noisy(image, how.noise, np.random.default_rng([self._seed, _NOISE, tick]))
        return image

    def _is_occluded(self) -> bool:
        """Draw whether the next frame is occluded: a chain of two states whose long-run share is `occlusion`."""
        share, stays = self._degradation.occlusion, self._degradation.burst_ticks
        if stays is None or self._occluded is None:
            probability = share
        elif self._occluded:
            probability = 1.0 - 1.0 / stays
        else:
            probability = share / (1.0 - share) / stays
        self._occluded = bool(self._bursts.random() < probability)
        return self._occluded


def _occluded(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Hide a rectangle that covers at least `LEAST_COVERED` of the image, anywhere in it, behind one colour."""
    height, width = image.shape[:2]
    covered = rng.uniform(LEAST_COVERED, 1.0)
    across = rng.uniform(covered, 1.0)
    columns, rows = min(width, math.ceil(across * width)), min(height, math.ceil(covered / across * height))
    left, top = rng.integers(0, width - columns + 1), rng.integers(0, height - rows + 1)
    hidden = image.copy()
    hidden[top : top + rows, left : left + columns] = rng.integers(0, 256, 3, dtype=np.uint8)
    return hidden


def _noisy(image: NDArray[np.uint8], sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    noise = sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _blurred(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), dtype=np.uint8)
