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


@pytest.mark.parametrize("queries", [0, 1, LENGTH, 3 * LENGTH])
def test_without_any_match_it_is_1(queries: int) -> None:
    assert local_speeds(Matches.none(queries), LENGTH).tolist() == [1.0] * queries


def test_without_a_sure_match_it_is_1() -> None:
    """Matches that jump about have no speed."""
    rng = np.random.default_rng(1)
    jumping = Matches(np.tile([0, 5000], 50)[rng.permutation(100)], np.ones(100))
    assert local_speeds(jumping, LENGTH) == pytest.approx(1.0, abs=0.02)
    standing = Matches(np.full(100, 7), np.ones(100))
    assert local_speeds(standing, LENGTH).tolist() == [1.0] * 100


def test_doubtful_matches_do_not_count() -> None:
    """Every other 20 frames say another speed, with a low score."""
    queries = np.arange(400)
    doubtful = queries // 20 % 2 == 1
    reference = np.round(np.where(doubtful, 0.5, 2.0) * queries).astype(np.int64)
    told = local_speeds(Matches(reference, np.where(doubtful, 0.05, 0.5)), LENGTH)
    deceived = local_speeds(Matches(reference, np.full(400, 0.5)), LENGTH)
    assert told[50:-50].min() > 1.5
    assert np.median(deceived) < 1.3


def test_where_nothing_near_is_sure_the_whole_traverse_tells() -> None:
    sure = matches_at(2.0 * np.arange(300))
    reference, score = sure.reference.copy(), sure.score.copy()
    reference[100:200], score[100:200] = -1, 0.0
    found = local_speeds(Matches(reference, score), LENGTH)
    assert found[150] == pytest.approx(2.0, rel=0.03)


def test_one_slope_is_hardly_believed() -> None:
    """One accident in 300 queries says 2.4; what is next to it may believe it a little, the ends not more."""
    reference = np.tile([0, 5000], 150)
    reference[110], reference[120] = 3000, 3024
    found = local_speeds(Matches(reference, np.ones(300)), LENGTH)
    assert found[120] == found.max()
    assert found.max() < 1.5
    assert found[[0, 299]] == pytest.approx(found[120], rel=0.25)
    assert (found >= 1.0).all()


@pytest.mark.parametrize("references", [100, 300, 1000])
def test_random_matches_look_neither_fast_nor_slow(references: int) -> None:
    """Wrong matches are spread over frames, of which there are more at fast slopes than at slow ones."""
    octaves = []
    for seed in range(40):
        random = np.random.default_rng(seed).integers(0, references, 200)
        octaves.append(np.log2(np.median(local_speeds(Matches(random, np.ones(200)), LENGTH))))
    assert abs(np.mean(octaves)) < 0.15
