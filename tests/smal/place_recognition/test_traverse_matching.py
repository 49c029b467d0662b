"""Ordered matching of whole traverses: one road that is driven again, at other speeds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.place_recognition import traverse_matching
from smal.place_recognition.matches import NONE
from smal.place_recognition.ordered_matching import OrderedSolution
from smal.place_recognition.traverse_matching import match_traverses, place_of
from tests.smal.place_recognition.ordered_problems import unit

LENGTH, N = 10, 240
Array = NDArray[np.float64]


class Walk:
    """Features that change smoothly along a road of n reference frames: neighbours resemble each other."""

    def __init__(self, rng: np.random.Generator, n: int = N, size: int = 96) -> None:
        steps = rng.normal(size=(n + 8, size))
        self._features = unit(np.array([steps[place : place + 8].sum(axis=0) for place in range(n)]))
        self._rng = rng

    def at(self, places: Array, noise: float) -> NDArray[np.float32]:
        """Return what is seen at places (q,) between the references, with noise of that length."""
        low = np.clip(np.floor(places).astype(int), 0, len(self._features) - 2)
        share = (places - low)[:, np.newaxis]
        seen = unit((1 - share) * self._features[low] + share * self._features[low + 1])
        disturbed = unit(seen + noise * unit(self._rng.normal(size=seen.shape)))
        return disturbed.astype(np.float32)


def drives() -> dict[str, Array]:
    """Return the places of some queries: at one speed, and at changing ones."""
    found = {f"{speed:g}": np.arange(20, 220, speed) for speed in (0.5, 0.7, 1.0, 1.4, 2.0)}
    changing = 2.0 ** np.sin(np.arange(400) / 25)
    places = 20 + np.cumsum(changing)
    sudden = 20 + np.cumsum(np.repeat([0.5, 2.0, 1.0], [60, 40, 60]))
    return found | {"waves": places[places < 220], "sudden": sudden[sudden < 220]}


@pytest.mark.parametrize("name", sorted(drives()))
def test_the_place_is_found_at_every_speed(name: str) -> None:
    places = drives()[name]
    walk = Walk(np.random.default_rng(0))
    references, queries = walk.at(np.arange(N, dtype=float), 0.4), walk.at(places, 0.8)
    matches = match_traverses(references, queries, LENGTH)
    assert matches.reference[: LENGTH - 1].tolist() == [NONE] * (LENGTH - 1)
    assert (matches.score[: LENGTH - 1] == 0.0).all()
    error = np.abs(matches.reference - places)[LENGTH - 1 :]
    assert matches.matched[LENGTH - 1 :].all()
    assert np.mean(error <= 2) >= 0.97


@pytest.mark.parametrize("name", ["0.5", "2", "waves"])
def test_the_second_round_knows_the_speed(name: str) -> None:
    """With frames so poor that the penalty on other speeds alone costs up to an eighth of the matches."""
    places, right = drives()[name], []
    for seed in range(3):
        walk = Walk(np.random.default_rng(seed))
        references, queries = walk.at(np.arange(N, dtype=float), 0.4), walk.at(places, 3.0)
        matches = match_traverses(references, queries, LENGTH)
        right.append(np.mean(np.abs(matches.reference - places)[LENGTH - 1 :] <= 2))
    assert np.mean(right) > 0.965


@pytest.mark.parametrize("who", ["queries", "references", "both"])
def test_who_stands_still_is_found(who: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For 25 frames each time, most of the traverse; at other places where both do."""
    rng = np.random.default_rng(4)
    walk = Walk(rng)

    def stopping(at: int) -> Array:
        return np.repeat(np.arange(20.0, 220.0), np.where(np.arange(200) % 20 == at, 25, 1))

    known = stopping(3) if who != "queries" else np.arange(float(N))
    places = stopping(10) if who != "references" else np.arange(20.0, 220.0)
    references, queries = walk.at(known, 0.1), walk.at(places, 0.1)

    def right() -> float:
        matches = match_traverses(references, queries, LENGTH)
        matched = np.flatnonzero(matches.matched)
        return float(np.mean(np.abs(known[matches.reference[matched]] - places[matched]) <= 2))

    assert right() > 0.99
    monkeypatch.setattr(traverse_matching, "first_frames", lambda features: np.arange(len(features)))
    assert right() < 0.95


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(0, 30), st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_sizes(seed: int, n: int, q: int, length: int) -> None:
    rng = np.random.default_rng(seed)
    references, queries = (unit(rng.normal(size=(count, 20))).astype(np.float32) for count in (n, q))
    done: list[int] = []
    matches = match_traverses(references, queries, length, progress=done.append)
    assert matches.reference.shape == matches.score.shape == (q,)
    assert not matches.matched[: length - 1].any()
    assert not (length > n and matches.matched.any())
    assert (matches.score >= 0.0).all()
    assert (matches.score[matches.matched] > 0.0).all()
    assert matches.reference.max(initial=NONE) < n
    assert done == sorted(done)
    assert done[-1] == q
    assert min(done) >= 0


def test_a_traverse_is_found_in_itself() -> None:
    references = Walk(np.random.default_rng(2), 60).at(np.arange(60, dtype=float), 0.0)
    matches = match_traverses(references, references.copy(), LENGTH)
    assert matches.reference[LENGTH - 1 :].tolist() == list(range(LENGTH - 1, 60))


def test_the_place_is_where_most_weight_ends() -> None:
    def place(ends: list[int], weights: list[float]) -> tuple[int, float]:
        return place_of(OrderedSolution(np.array(ends), np.array(weights), 1.0, 0.0, 0.5), 100)

    assert place([40], [0.5]) == (40, pytest.approx(0.5))
    # Two at one place, of different speeds (number v n + e), against a heavier one elsewhere.
    assert place([40, 142, 80], [0.3, 0.3, 0.4]) == (41, pytest.approx(0.36))
    assert place([40, 44], [0.3, 0.1]) == (40, pytest.approx(0.09 / 0.4))


def test_bad_settings_are_refused() -> None:
    features = np.eye(12, dtype=np.float32)
    with pytest.raises(ValueError, match="length of at least 1"):
        match_traverses(features, features, 0)
    for penalty in (0.0, 1.0, float("nan")):
        with pytest.raises(ValueError, match="above 0 and below 1"):
            match_traverses(features, features, 2, penalty)
