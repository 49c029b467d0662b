"""Stops of a traverse, by hand and by search."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.place_recognition.stops import LEAST_FRAMES, REACH, first_frames, windows
from tests.smal.place_recognition.ordered_problems import unit, walk


def seen(places: list[int], noise: float = 0.05, seed: int = 0) -> NDArray[np.float32]:
    """Return unit vectors of places along a way, each with noise of its own."""
    rng = np.random.default_rng(seed)
    way = walk(rng, max(places) + 1, 40)
    return unit(way[places] + noise * unit(rng.normal(size=(len(places), 40)))).astype(np.float32)


def stops_of(features: NDArray[np.float32]) -> list[int]:
    return first_frames(features).tolist()


def standing(*counts: int) -> list[int]:
    """Return places, each so many times."""
    return [place for place, count in enumerate(counts) for _ in range(count)]


def test_stops_are_found_where_they_are() -> None:
    counts = [1] * 10 + [8] + [1] * 10 + [LEAST_FRAMES] + [1] * 10
    expected = list(range(10)) + [10] * 8 + list(range(18, 28)) + [28] * LEAST_FRAMES + list(range(32, 42))
    assert stops_of(seen(standing(*counts))) == expected


def test_a_stop_may_be_long_and_be_most_of_the_traverse() -> None:
    long = 5 * REACH
    expected = [*range(40), *[40] * long, *range(40 + long, 45 + long)]
    assert stops_of(seen(standing(*[1] * 40, long, *[1] * 5))) == expected


@pytest.mark.parametrize("features", [np.zeros((9, 4)), np.ones((9, 4)), np.zeros((0, 4)), np.ones((2, 4))])
def test_where_nothing_ever_moves_there_is_no_stop(features: NDArray[np.float64]) -> None:
    assert stops_of(features.astype(np.float32)) == list(range(len(features)))


@given(st.lists(st.integers(1, 7), max_size=12), st.integers(1, 6))
def test_windows_count_every_stop_once(counts: list[int], length: int) -> None:
    first = np.array([sum(counts[:run]) for run, count in enumerate(counts) for _ in range(count)], dtype=np.int64)
    found = windows(first, length)
    assert found.shape == (max(0, first.size - length + 1), length)
    for end, window in enumerate(found.tolist(), length - 1):
        runs = sorted(set(first[: end + 1].tolist()))
        whole = len(runs) >= length
        assert window == ([*runs[-length:-1], end] if whole else list(range(end - length + 1, end + 1)))
