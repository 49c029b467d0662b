"""Degradations do what they say, in the same frames for the same seed, and leave the given image alone."""

import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import DEGRADATIONS, Degrader


def texture(seed: int = 0, height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """Return an image in which no two neighbouring pixels are alike."""
    image = np.random.default_rng(seed).integers(0, 128, (height, width, 3), dtype=np.uint8)
    image[::2, ::2] += 128
    return image


def test_the_same_seed_damages_the_same_frames_in_the_same_way() -> None:
    image = texture()

    def frames(seed: int, name: str = "poor") -> NDArray[np.uint8]:
        degrader = Degrader(DEGRADATIONS[name], seed)
        return np.stack([degrader.apply(tick, image) for tick in range(60)])

    np.testing.assert_array_equal(frames(5), frames(5))
    assert (frames(5) != frames(6)).any(axis=(1, 2, 3)).all()
    occluded = (frames(5, "occluded") != image).any(axis=(1, 2, 3))
    assert 0.2 < occluded.mean() < 0.5
    assert (frames(5, "clean") == image).all()
