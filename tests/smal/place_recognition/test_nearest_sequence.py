"""Nearest sequences against a search by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.place_recognition.matches import NONE, ignore
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from tests.smal.place_recognition.traverses import random_features


def by_hand(references: NDArray[np.float32], queries: NDArray[np.float32], length: int, end: int) -> list[float]:
    """Return the mean product of the window that ends at a query with each reference sequence, first end first."""
    window = queries[end - length + 1 : end + 1].astype(np.float64)
    return [
        float(np.mean([window[k] @ references[start + k] for k in range(length)]))
        for start in range(references.shape[0] - length + 1)
    ]


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(0, 25), st.integers(1, 8))
@settings(max_examples=60, deadline=None)
def test_equals_a_search_by_hand(seed: int, n: int, q: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    references, queries = random_features(rng, n), random_features(rng, q)
    matches = match_nearest_sequence(references, queries, length, ignore)
    first = length - 1 if length <= n else q
    assert matches.reference[:first].tolist() == [NONE] * min(first, q)
    for end in range(first, q):
        means = by_hand(references, queries, length, end)
        assert matches.score[end] == pytest.approx(max(means), abs=1e-5)
        assert means[matches.reference[end] - length + 1] == pytest.approx(max(means), abs=1e-5)
    assert (np.abs(matches.score) <= 1 + 1e-6).all()


def test_a_copy_is_found_exactly() -> None:
    references = random_features(np.random.default_rng(0), 50)
    matches = match_nearest_sequence(references, references[17:40], 5, ignore)
    assert matches.reference.tolist() == [NONE] * 4 + list(range(21, 40))
    assert matches.score[4:] == pytest.approx(1.0, abs=1e-5)
