"""`smal.match`, and its parts: centring, the nearest sequence, the chain."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import smal
from smal.features import Centering, FeatureSettings
from smal.place_recognition.hidden_markov import SPEEDS, Chain, smoothed
from smal.place_recognition.matches import NONE, Matches, ignore
from smal.place_recognition.methods import FEATURES
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.place_recognition.traverse_centering import PRIOR_FRAMES, centre_traverses
from tests.smal.place_recognition.traverses import Walk, random_features


def test_surest_matches_have_the_requested_precision() -> None:
    """Of scores .99, .9, .9 and .5 the first three are right in 93 of 100 cases."""
    matches = Matches(np.arange(5), np.array([0.9, 0.5, 0.99, 0.9, 0.0]), np.zeros(5))
    assert matches.surest(0.93).matched.tolist() == [True, False, True, True, False]
    assert matches.surest(0.95).reference.tolist() == [NONE, NONE, 2, NONE, NONE]
    assert not matches.surest(0.999).matched.any()
    assert not Matches.none(3).surest(0.5).matched.any()


FRAMES = 30
WALL = cv2.resize(np.random.default_rng(3).integers(0, 256, (6, 90, 3), dtype=np.uint8), (1240, 72))


def images(share: float) -> NDArray[np.uint8]:
    """Return what a camera sees that passes a wall, so bright."""
    views = [WALL[:, 36 * place : 36 * place + 96] for place in range(FRAMES)]
    return (share * np.array(views)).astype(np.uint8)


def test_images_are_an_array_or_come_one_after_the_other() -> None:
    found = smal.match(images(1.0), (image for image in images(0.7)))
    assert (np.abs(found.reference - np.arange(FRAMES)) <= 1).all()
    again = smal.match(images(1.0), np.array([smal.extract(one, FEATURES) for one in images(0.7)]))
    np.testing.assert_allclose(found.score, again.score)


def test_features_are_of_any_kind() -> None:
    walk = Walk(np.random.default_rng(0), 200)
    places = np.arange(30.0, 180.0)
    references = walk.at(np.arange(200.0), 0.4) + 3.0
    queries = walk.at(places, 1.0) - 2.0
    for method in ("smal", "nearest"):
        found = smal.match(references, queries, method=method)
        right = np.abs(found.reference - places)[found.matched] <= 6
        assert right.mean() > 0.8
    assert smal.match(references, queries + 5.0, tolerance=2, lag=3).score[20:].mean() > 0.8


def test_way_is_a_loop_when_it_is_driven_twice() -> None:
    walk = Walk(np.random.default_rng(0), 200)
    there = np.tile(np.arange(150.0), 2)
    found = smal.match(walk.at(there, 0.5), tolerance=2)
    assert found.score[:140].max() < 0.2
    assert found.score[160:].mean() > 0.9
    assert (np.abs(there[found.reference] - there)[160:] <= 2).mean() > 0.97


SETTINGS = FeatureSettings.of(("color", "thumbnail"))
RNG = np.random.default_rng(0)
REFERENCES = RNG.normal(size=(40, SETTINGS.size)).astype(np.float32)


@pytest.mark.parametrize("count", [1, PRIOR_FRAMES, 3 * PRIOR_FRAMES])
def test_prior_counts_as_frames(count: int) -> None:
    queries = RNG.normal(size=(count, SETTINGS.size)).astype(np.float32)
    frames = np.concatenate([queries, np.tile(REFERENCES.mean(axis=0), (PRIOR_FRAMES, 1))])
    expected = Centering.fit(frames, SETTINGS).apply(queries)
    np.testing.assert_allclose(
        centre_traverses(REFERENCES, queries, SETTINGS)[1], expected, atol=1e-4
    )


def test_causal_centering_ignores_later_queries() -> None:
    queries = RNG.normal(size=(30, SETTINGS.size)).astype(np.float32)
    causal = centre_traverses(REFERENCES, queries, SETTINGS, causal=True)[1]
    for seen in (1, 7, 30):
        known = centre_traverses(REFERENCES, queries[:seen], SETTINGS)[1]
        np.testing.assert_allclose(causal[seen - 1], known[-1], atol=1e-4)


def by_hand(
    references: NDArray[np.float32], queries: NDArray[np.float32], length: int, end: int
) -> list[float]:
    """Return the mean product of the window that ends at a query with each reference sequence, first end first."""
    window = queries[end - length + 1 : end + 1].astype(np.float64)
    return [
        float(np.mean([window[k] @ references[start + k] for k in range(length)]))
        for start in range(references.shape[0] - length + 1)
    ]


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(0, 25), st.integers(1, 8))
@settings(max_examples=60)
def test_equals_a_search_by_hand(seed: int, n: int, q: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    references = random_features(rng, n)
    queries = random_features(rng, q)
    matches = match_nearest_sequence(references, queries, length, ignore)
    first = length - 1 if length <= n else q
    assert matches.reference[:first].tolist() == [NONE] * min(first, q)
    for end in range(first, q):
        means = by_hand(references, queries, length, end)
        assert matches.score[end] == pytest.approx(max(means), abs=1e-5)
        assert means[matches.reference[end] - length + 1] == pytest.approx(max(means), abs=1e-5)
    assert (np.abs(matches.score) <= 1 + 1e-6).all()


def dense(chain: Chain) -> np.ndarray:
    """Return how likely each state (a column) becomes each other one."""
    return np.array(
        [chain.ahead(one) for one in np.eye(chain.first().size, dtype=np.float32)]
    ).T.astype(np.float64)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 20))
@settings(max_examples=40)
def test_probabilities_are_those_of_dense_matrices(
    seed: int, references: int, queries: int
) -> None:
    chain = Chain(references)
    rng = np.random.default_rng(seed)
    moves = dense(chain)
    np.testing.assert_allclose(moves.sum(axis=0), 1.0, atol=1e-5)
    ratios = np.exp(rng.normal(scale=2.0, size=(queries, references))).astype(np.float32)
    answers = {
        query: (there, none) for query, there, none in smoothed(chain, ratios, lambda row: row)
    }
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


def test_traverse_is_nowhere_when_it_runs_off_the_end() -> None:
    """Follow the references one at a time up to the last one."""
    chain = Chain(20)
    belief = chain.first()
    for here in range(10, 20):
        ratios = np.where(np.arange(20) == here, 1e4, 1.0).astype(np.float32)
        belief = chain.weighed(chain.ahead(belief), ratios)
    assert chain.at_references(chain.ahead(belief))[1] > 0.9
