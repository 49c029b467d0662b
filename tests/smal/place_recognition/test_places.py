"""Places of queries among references, for drives at any speed and direction."""

import itertools
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.features.extraction import in_parallel
from smal.place_recognition import places as module
from smal.place_recognition.hidden_markov import Chain, smoothed
from smal.place_recognition.places import match_places
from tests.smal.place_recognition.traverses import Walk
from tests.smal.worlds import unit

N = 240
LAGGED = (
    "2.5",
    "waves",
    "stops",
)  # Drives that are followed with a lag as well, which takes longer.
Array = NDArray[np.float64]


def drives() -> dict[str, Array]:
    """Return the places of some queries: at one speed, at changing ones, backwards, in laps, after a jump."""
    found = {f"{speed:g}": np.arange(20, 220, speed) for speed in (0.3, 1.0, 2.5, 3.7)}
    places = 20 + np.cumsum(2.0 ** np.sin(np.arange(400) / 25))
    sudden = 20 + np.cumsum(np.repeat([0.5, 2.0, 1.0], [60, 40, 60]))
    return found | {
        "waves": places[places < 220],
        "sudden": sudden[sudden < 220],
        "backwards": np.arange(220.0, 20.0, -1.3),
        "laps": np.tile(np.arange(40.0, 120.0), 3),
        "stops": np.repeat(np.arange(20.0, 220.0), np.where(np.arange(200) % 20 == 10, 25, 1)),
        "there and back": np.append(np.arange(60.0, 160.0), np.arange(160.0, 60.0, -1.0)),
    }


def traverses(
    places: Array, noise: float, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    walk = Walk(np.random.default_rng(seed), N)
    return walk.at(np.arange(N, dtype=float), 0.4), walk.at(places, noise)


@pytest.mark.parametrize(
    ("name", "lag"),
    [*((name, None) for name in sorted(drives())), *((name, 10) for name in LAGGED)],
)
def test_place_is_found(name: str, lag: int | None) -> None:
    places = drives()[name]
    matches = match_places(*traverses(places, 1.5), lag=lag)
    right = np.abs(matches.reference - places) <= 2
    assert right.mean() >= (0.97 if lag is None else 0.9)
    assert matches.score[right].mean() > 0.9


def test_scores_are_the_share_that_is_right() -> None:
    said = []
    true = []
    for seed in range(4):
        places = drives()["waves"]
        matches = match_places(*traverses(places, 14.0, seed), tolerance=3)
        said.append(matches.score)
        true.append(np.abs(matches.reference - places) <= 3)
    scores = np.concatenate(said)
    right = np.concatenate(true)
    assert 0.8 < right.mean() < 0.95
    assert abs(scores.mean() - right.mean()) < 0.1


def test_query_without_reference_is_unknown() -> None:
    """The references lack a third of the way."""
    places = np.arange(10.0, 230.0)
    references, queries = traverses(places, 1.0)
    matches = match_places(np.delete(references, np.arange(80, 160), axis=0), queries)
    # A few frames pass before it is sure.
    lacking = (places >= 100) & (places < 145)
    known = (places < 75) | (places > 165)
    assert matches.unknown[lacking].min() > 0.9
    assert matches.unknown[known].max() < 0.1
    assert matches.score[lacking].max() < 0.1
    surest = matches.surest(0.99)
    assert surest.matched[known].mean() > 0.9
    assert not surest.matched[lacking].any()


def test_either_of_two_visits_is_a_match() -> None:
    """The references show the way twice."""
    places = np.arange(60.0, 200.0)
    walk = Walk(np.random.default_rng(0), N)
    ways = np.tile(np.arange(20.0, 220.0), 2)
    matches = match_places(walk.at(ways, 0.4), walk.at(places, 1.0))
    assert (np.abs(ways[matches.reference] - places) <= 2).mean() > 0.97


def test_parts_answer_as_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ways = np.tile(np.append(np.arange(20.0, 220.0), np.arange(220.0, 20.0, -1.0)), 6)
    references, queries = traverses(ways, 7.0)
    monkeypatch.setattr(
        module, "_learned", lambda *_: module.Evidence()
    )  # Learned, it would be of other queries.
    by_parts = match_places(references, queries, 3, parallel=map)
    monkeypatch.setattr(module, "_PART", len(queries))
    whole = match_places(references, queries, 3)
    assert (
        0.5 < whole.score.mean() < 0.98
    )  # Not so clear that nothing before and after would count.
    np.testing.assert_array_equal(by_parts.reference, whole.reference)
    np.testing.assert_allclose(by_parts.score, whole.score, atol=1e-4)


def test_abandoned_work_ends() -> None:
    begun = threading.Event()
    looks = itertools.count()

    def ratios(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        begun.set()
        next(looks)
        time.sleep(0.02)
        return seen

    def work(seen: NDArray[np.float32] | None) -> int:
        return 0 if seen is None else len(list(smoothed(Chain(1), seen, ratios)))

    answers = in_parallel(work, [None, np.ones((10_000, 1), np.float32)])
    next(answers)
    begun.wait()
    answers.close()
    assert next(looks) < 100, (
        "looks at each of a hundred blocks, of which it would look at each twice"
    )


def test_answers_depend_on_no_frame_after_the_lag() -> None:
    references, queries = traverses(drives()["waves"], 3.0)
    for lag in (0, 7):
        whole, part = (match_places(references, queries[:some], 2, lag) for some in (90, 60))
        np.testing.assert_array_equal(whole.reference[: 60 - lag], part.reference[: 60 - lag])
        np.testing.assert_array_equal(whole.score[: 60 - lag], part.score[: 60 - lag])


@given(
    st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 30), st.sampled_from([None, 0, 3])
)
@settings(max_examples=20)
def test_sizes(seed: int, n: int, q: int, lag: int | None) -> None:
    rng = np.random.default_rng(seed)
    references, queries = (
        unit(rng.normal(size=(count, 20))).astype(np.float32) for count in (n, q)
    )
    queries[rng.random(q) < 0.2] = 0.0
    done: list[int] = []
    matches = match_places(references, queries, lag=lag, progress=done.append)
    assert matches.reference.shape == matches.score.shape == matches.unknown.shape == (q,)
    assert ((matches.score >= 0.0) & (matches.score <= 1.0 + 1e-5)).all()
    assert matches.reference.max(initial=0) < n
    assert done == sorted(done)
    assert done[-1] == q
