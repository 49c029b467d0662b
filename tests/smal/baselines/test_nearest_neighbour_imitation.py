"""Nearest-neighbour imitation against the plain sum of squares, frame by frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.demonstration import Demonstration
from smal.evaluation.baselines.nearest_neighbour_imitation import NearestNeighbourImitation
from smal.features import Centering, extract
from smal.movement import Atom
from tests.services.chain import picture
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


def test_it_acts_as_at_the_nearest_image() -> None:
    images = [picture(place) for place in (1, 20, 40)]
    features = np.stack([extract(image, COLOR) for image in images])
    atoms = np.array([Atom.FORWARD, Atom.LEFT, Atom.STOP], dtype=np.int8)
    imitation = NearestNeighbourImitation([Demonstration("d", features, atoms)], COLOR)
    assert [imitation.step(image) for image in images] == [Atom.FORWARD, Atom.LEFT, Atom.STOP]
    with pytest.raises(ValueError, match="no demonstration"):
        NearestNeighbourImitation([], COLOR)
