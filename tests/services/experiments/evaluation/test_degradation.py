"""Degradations do what they say, in the same frames for the same seed, and leave the given image alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import DEGRADATIONS, LEAST_COVERED, Degradation, Degrader


def texture(seed: int = 0, height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """Return an image in which no two neighbouring pixels are alike."""
    image = np.random.default_rng(seed).integers(0, 128, (height, width, 3), dtype=np.uint8)
    image[::2, ::2] += 128
    return image


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), height=st.integers(24, 70), width=st.integers(32, 90))
def test_an_occluder_is_a_rectangle_of_one_colour_over_half_the_image_or_more(
    seed: int, height: int, width: int
) -> None:
    image = texture(seed, height, width)
    before = image.copy()
    seen = Degrader(Degradation(occlusion=1.0), seed).apply(0, image)
    np.testing.assert_array_equal(image, before)
    colours, counts = np.unique(seen[(image != seen).any(axis=2)], axis=0, return_counts=True)
    hidden = (seen == colours[counts.argmax()]).all(axis=2)
    rows, columns = np.flatnonzero(hidden.any(axis=1)), np.flatnonzero(hidden.any(axis=0))
    inside = hidden[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    assert inside.mean() > 0.99
    assert inside.sum() >= LEAST_COVERED * height * width
    np.testing.assert_array_equal(seen[~hidden], image[~hidden])


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
