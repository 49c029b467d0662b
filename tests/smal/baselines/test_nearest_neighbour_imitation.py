"""Nearest-neighbour imitation against the plain sum of squares, frame by frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.demonstration import Demonstration
from smal.evaluation.baselines.nearest_neighbour_imitation import NearestNeighbourImitation
from smal.features import Centering
from smal.movement import Atom
from tests.smal.worlds import COLOR, corridor, drive


def demonstrations(seed: int, lengths: list[int]) -> list[Demonstration]:
    views = corridor(max(lengths) + 5, seed=seed)
    return [drive(views, 0, seed + k, name=f"d{k}", end=length) for k, length in enumerate(lengths)]


def by_hand(taught: list[Demonstration], seen: NDArray[np.float32], frames: int) -> int:
    """Return the last frame of the nearest window, counted over all demonstrations, by summing squares."""
    centering = Centering.fit([one.features for one in taught], COLOR)
    window = centering.apply(seen[-frames:])
    best, where, offset = np.inf, -1, 0
    for one in taught:
        templates = centering.apply(one.features).astype(np.float64)
        for end in range(len(window) - 1, len(templates)):
            total = float(np.square(templates[end - len(window) + 1 : end + 1] - window).sum())
            if total < best:
                best, where = total, offset + end
        offset += len(templates)
    return where


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    frames=st.sampled_from([1, 2, 5]),
    lengths=st.lists(st.integers(6, 12), min_size=1, max_size=3),
)
def test_nearest_window_is_that_of_the_least_sum_of_squares(seed: int, frames: int, lengths: list[int]) -> None:
    taught = demonstrations(seed, lengths)
    seen = drive(corridor(20, seed=seed), 2, seed + 99, name="run").features[:9]
    imitation = NearestNeighbourImitation(taught, COLOR, frames)
    for tick in range(len(seen)):
        assert imitation.nearest(seen[tick]) == by_hand(taught, seen[: tick + 1], frames)


@pytest.mark.parametrize("frames", [1, 5])
def test_it_does_what_was_done_in_a_demonstration_that_it_sees_again(frames: int) -> None:
    taught = demonstrations(3, [40, 60, 50])
    imitation = NearestNeighbourImitation(taught, COLOR, frames)
    for one in taught:
        imitation.reset()
        assert [imitation.act(view) for view in one.features] == [Atom(int(atom)) for atom in one.atoms]


def test_an_episode_may_be_shorter_and_demonstrations_too_than_the_window() -> None:
    taught = demonstrations(5, [6, 8])
    imitation = NearestNeighbourImitation(taught, COLOR, 20)
    one = taught[1]
    assert [imitation.act(view) for view in one.features] == [Atom(int(atom)) for atom in one.atoms]
    for view in one.features:
        imitation.act(view)


def test_bad_use_is_named() -> None:
    with pytest.raises(ValueError, match="no demonstration"):
        NearestNeighbourImitation([], COLOR)
    with pytest.raises(ValueError, match="frames must be at least 1, got 0"):
        NearestNeighbourImitation(demonstrations(1, [6]), COLOR, 0)
