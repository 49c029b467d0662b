"""Every method of the table on one made-up road, and the paper's against the program that it states."""

import numpy as np
import pytest
from numpy.typing import NDArray

from smal import solve
from smal.features import FeatureSettings
from smal.paper.phase import matched_phase
from smal.paper.state_matching import usual_lambda
from smal.place_recognition.matches import NONE, ignore
from smal.place_recognition.methods import METHODS, MatchSettings, Method
from smal.place_recognition.paper_matching import match_as_in_the_paper
from tests.smal.place_recognition.traverses import Road, Walk
from tests.smal.worlds import unit

N = 100
FIRST = 20
LAST = 80


def raw_traverses(
    features: FeatureSettings, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Make raw features of a road, and of its frames 20..79 seen again with noise and in other light."""
    rng = np.random.default_rng(seed)
    road = Road(rng, features.size).at(np.arange(N))
    again = road[FIRST:LAST] + rng.normal(scale=0.5, size=(LAST - FIRST, features.size)) + 0.3
    return road + 1.0, again.astype(np.float32) + 1.0


def settings_of(method: Method) -> MatchSettings:
    return MatchSettings(method.features, method.length)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_finds_its_way(name: str) -> None:
    method = METHODS[name]
    references, queries = raw_traverses(method.features)
    before = references.copy(), queries.copy()
    done: list[int] = []
    matches = method.match(references, queries, settings_of(method), done.append)
    assert done[-1] == LAST - FIRST
    assert matches.reference[: method.length - 1].tolist() == [NONE] * (method.length - 1)
    error = np.abs(matches.reference - np.arange(FIRST, LAST))[matches.matched]
    assert matches.matched[method.length - 1 :].mean() > 0.9
    assert np.mean(error <= 2) > 0.9
    # The command keeps the raw features for other uses.
    assert np.array_equal(references, before[0])
    assert np.array_equal(queries, before[1])


@pytest.mark.parametrize("name", sorted(METHODS))
def test_no_method_finds_a_match_when_frames_are_too_few(name: str) -> None:
    method = METHODS[name]
    length = 6 if method.any_length else method.length
    references, queries = raw_traverses(method.features)
    for known, asked in ((references[: length - 1], queries), (references, queries[: length - 1])):
        done: list[int] = []
        chosen = MatchSettings(method.features, length)
        matches = method.match(known, asked, chosen, done.append)
        assert matches.matched.tolist() == [False] * len(asked)
        assert done[-1] == len(asked)


@pytest.mark.parametrize("name", ["image", "nearest", "paper", "smal"])
def test_one_photo_is_found(name: str) -> None:
    method = METHODS[name]
    references, queries = raw_traverses(method.features)
    for query in range(0, LAST - FIRST, 7):
        chosen = MatchSettings(method.features, 1)
        matches = method.match(references, queries[query : query + 1], chosen, ignore)
        assert abs(int(matches.reference[0]) - (FIRST + query)) <= 2


@pytest.mark.parametrize("length", [1, 4])
def test_paper_is_eq_7_of_the_same_window(length: int) -> None:
    rng = np.random.default_rng(length)
    references = Walk(rng, 42, 32).at(
        np.arange(42.0), 0.0
    )  # two frames are in no whole sequence at l = 4
    queries = unit(references[5:25] + 0.1 * rng.normal(size=(20, 32))).astype(np.float32)
    matches = match_as_in_the_paper(references, queries, length, ignore)
    penalty = usual_lambda(length)
    templates = references[: 42 // length * length].T
    for query in range(length - 1, 20):
        window = queries[query + 1 - length : query + 1].T
        solution = solve(templates, window, length, penalty, penalty, 1e-5)
        weights = np.abs(solution.weights).reshape(-1, length * length).sum(axis=1)
        best = int(np.argmax(weights))
        assert abs(matches.reference[query] - (best * length + matched_phase(solution, best))) < 0.6
        assert matches.score[query] == pytest.approx(weights[best] / length, abs=0.02)
    assert matches.reference[: length - 1].tolist() == [NONE] * (length - 1)
