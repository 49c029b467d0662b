"""Local speeds from matches that are known to be right, and from some that are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.place_recognition import Matches
from smal.place_recognition.speed import local_speeds

LENGTH = 10


def matches_at(places: NDArray[np.float64], wrong: float = 0.0, seed: int = 0) -> Matches:
    """Make sure matches at places (q,), without the first window; a share of them wrong, and as sure."""
    rng = np.random.default_rng(seed)
    reference = np.round(places).astype(np.int64)
    outliers = rng.random(places.size) < wrong
    reference[outliers] = rng.integers(0, reference.max() + 1, outliers.sum())
    reference[: LENGTH - 1] = -1
    return Matches(reference, np.where(reference < 0, 0.0, rng.uniform(0.5, 0.6, places.size)))


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.4, 2.0])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_the_speed_is_recovered(speed: float, wrong: float) -> None:
    found = local_speeds(matches_at(speed * np.arange(200), wrong), LENGTH)
    assert found.shape == (200,)
    # Doubt draws towards 1, the more the fewer matches are sure; most of all at the ends.
    error = np.abs(np.log2(found) - np.log2(speed))
    assert np.median(error) < 0.25
    assert error[2 * LENGTH : -2 * LENGTH].max() < 0.4


def test_the_speed_varies_along_the_traverse() -> None:
    places = np.concatenate([0.5 * np.arange(150), 75 + 2.0 * np.arange(150)])
    found = local_speeds(matches_at(places, 0.1), LENGTH)
    assert np.median(found[30:110]) < 0.6
    assert np.median(found[190:]) > 1.6
    assert (found >= 0.5).all()
    assert (found <= 2.0).all()
