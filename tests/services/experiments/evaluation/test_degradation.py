"""Degradations do what they say, in the same frames for the same seed, and leave the given image alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.experiments.evaluation.degradation import (
    CLEAN,
    DEGRADATIONS,
    LEAST_COVERED,
    Degradation,
    Degrader,
    degradation_named,
)


def texture(seed: int = 0, height: int = 60, width: int = 80) -> NDArray[np.uint8]:
    """Return an image in which no two neighbouring pixels are alike."""
    image = np.random.default_rng(seed).integers(0, 128, (height, width, 3), dtype=np.uint8)
    image[::2, ::2] += 128
    return image


def hidden(image: NDArray[np.uint8], seen: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels that have the colour of the occluder, which is that of most changed pixels."""
    changed = (image != seen).any(axis=2)
    colours, counts = np.unique(seen[changed].reshape(-1, 3), axis=0, return_counts=True)
    return (seen == colours[counts.argmax()]).all(axis=2)


def occluded_ticks(degradation: Degradation, seed: int, ticks: int) -> NDArray[np.bool_]:
    degrader, image = Degrader(degradation, seed), texture(height=6, width=8)
    return np.array([(degrader.apply(tick, image) != image).any() for tick in range(ticks)])


def test_a_clean_view_is_the_image_itself() -> None:
    image = texture()
    assert Degrader(CLEAN, 3).apply(0, image) is image


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), height=st.integers(24, 70), width=st.integers(32, 90))
def test_an_occluder_is_a_rectangle_of_one_colour_over_half_the_image_or_more(
    seed: int, height: int, width: int
) -> None:
    image = texture(seed, height, width)
    before = image.copy()
    seen = Degrader(Degradation(occlusion=1.0 - 1e-12), seed).apply(0, image)
    np.testing.assert_array_equal(image, before)
    where = hidden(image, seen)
    rows, columns = np.flatnonzero(where.any(axis=1)), np.flatnonzero(where.any(axis=0))
    inside = where[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    assert inside.mean() > 0.99
    assert inside.sum() >= LEAST_COVERED * height * width
    outside = ~where
    np.testing.assert_array_equal(seen[outside], image[outside])


def test_bursts_last_as_long_and_are_as_frequent_as_declared() -> None:
    found = np.concatenate(
        [occluded_ticks(Degradation(occlusion=0.3, burst_ticks=6.0), seed, 1000) for seed in range(10)]
    )
    assert found.mean() == pytest.approx(0.3, abs=0.04)
    assert found.sum() / np.count_nonzero(np.diff(found.astype(int)) == 1) == pytest.approx(6.0, rel=0.15)


def test_the_same_seed_damages_the_same_frames_in_the_same_way() -> None:
    how, image = DEGRADATIONS["poor"], texture()

    def frames(seed: int) -> NDArray[np.uint8]:
        degrader = Degrader(how, seed)
        return np.stack([degrader.apply(tick, image) for tick in range(20)])

    np.testing.assert_array_equal(frames(5), frames(5))
    assert (frames(5) != frames(6)).any(axis=(1, 2, 3)).all()


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"occlusion": 1.0}, "occlusion"),
        ({"occlusion": -0.1}, "occlusion"),
        ({"noise": -1.0}, "noise"),
        ({"blur_px": float("nan")}, "blur_px"),
        ({"shake": -1.0}, "shake"),
        ({"occlusion": 0.8, "burst_ticks": 2.0}, "burst_ticks"),
        ({"burst_ticks": 0.5}, "burst_ticks"),
    ],
)
def test_numbers_out_of_range_are_named(values: dict[str, float], names: str) -> None:
    with pytest.raises(ValueError, match=names):
        Degradation(**values)


def test_names() -> None:
    assert degradation_named("clean") == CLEAN
    assert degradation_named("occluded").meaning == "35% of the frames occluded by half or more"
    with pytest.raises(ValueError, match="unknown degradation 'foggy'; known are clean, occluded"):
        degradation_named("foggy")
