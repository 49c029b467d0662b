"""The chain keeps probability, and what is computed in pieces is what dense matrices give."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.place_recognition.hidden_markov import SPEEDS, Chain, smoothed


def dense(chain: Chain) -> np.ndarray:
    """Return how likely each state (a column) becomes each other one."""
    return np.array([chain.ahead(one) for one in np.eye(chain.first().size, dtype=np.float32)]).T.astype(np.float64)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 20))
@settings(max_examples=40, deadline=None)
def test_probabilities_are_those_of_dense_matrices(seed: int, references: int, queries: int) -> None:
    chain, rng = Chain(references), np.random.default_rng(seed)
    moves = dense(chain)
    np.testing.assert_allclose(moves.sum(axis=0), 1.0, atol=1e-5)
    ratios = np.exp(rng.normal(scale=2.0, size=(queries, references))).astype(np.float32)
    answers = {query: (there, none) for query, there, none in smoothed(chain, ratios, lambda row: row)}
    seen = np.column_stack([np.tile(ratios, 2 * len(SPEEDS)), np.ones(queries)]).astype(np.float64)
    before = [chain.first() * seen[0]]
    for query in range(1, queries):
        before.append(moves @ before[-1] / before[-1].sum() * seen[query])
    after = np.ones_like(before[0])
    for query in reversed(range(queries)):
        both = before[query] * after
        both /= both.sum()
        there, none = answers[query]
        np.testing.assert_allclose(there, both[:-1].reshape(-1, references).sum(axis=0), atol=1e-4)
        assert none == pytest.approx(both[-1], abs=1e-4)
        after = moves.T @ (after * seen[query])
        after /= after.max()


def test_who_runs_off_the_end_is_nowhere() -> None:
    """At the last reference, at one reference a query."""
    chain = Chain(20)
    belief = np.zeros_like(chain.first())
    belief[SPEEDS.index(1.0) * 20 + 19] = 1.0
    assert chain.at_references(chain.ahead(belief))[1] > 0.9
