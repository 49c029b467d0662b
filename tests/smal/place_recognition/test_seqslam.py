"""SeqSLAM against its equations, term by term, and on traverses of known speed."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from smal.place_recognition import trajectories
from smal.place_recognition.matches import NONE, Matches, ignore
from smal.place_recognition.seqslam import SeqSlamSettings, differences, match_seqslam
from tests.smal.place_recognition.traverses import Road, random_features


@dataclass
class ByHand:
    """The equations of `match_seqslam` with loops, in double precision."""

    references: NDArray[np.float32]
    queries: NDArray[np.float32]
    given: SeqSlamSettings

    def __post_init__(self) -> None:
        self.half = self.given.window // 2
        self.enhanced = [self._enhanced_row(t) for t in range(len(self.queries))]

    def _enhanced_row(self, t: int) -> list[float]:
        row = [float(np.mean(np.abs(self.queries[t].astype(float) - x.astype(float)))) for x in self.references]
        result = []
        for i, value in enumerate(row):
            around = [row[j] for j in range(len(row)) if abs(j - i) <= self.half]
            result.append(float((value - np.mean(around)) / np.std(around)) if np.std(around) > 1e-9 else 0.0)
        return result

    def cost(self, t: int, end: int) -> float:
        """S(t, e)."""
        least = math.inf
        for step in range(math.floor((self.given.v_max - self.given.v_min) / self.given.v_step + 1e-9) + 1):
            # Not a running sum: its rounding decides where 0.9 times 5 goes.
            velocity = self.given.v_min + self.given.v_step * step
            steps = [math.floor(velocity * k + 0.5) for k in range(self.given.length)]
            if end - steps[-1] >= 0:
                least = min(least, float(np.mean([self.enhanced[t - k][end - s] for k, s in enumerate(steps)])))
        return least

    def uniqueness(self, costs: list[float], best: int) -> float:
        """Return the score, given which end is the best."""
        offset = math.sqrt(2 * self.half + 1)
        outside = [c for e, c in enumerate(costs) if abs(e - best) > self.half and c < math.inf]
        second = min(outside, default=0.0) + offset
        return 1.0 - min(1.0, (costs[best] + offset) / second)


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 25),
    st.integers(0, 14),
    st.builds(
        SeqSlamSettings,
        length=st.integers(1, 6),
        window=st.integers(2, 12),
        v_min=st.sampled_from([0.5, 0.8, 1.0]),
        v_max=st.sampled_from([1.0, 1.2, 2.0]),
        v_step=st.sampled_from([0.1, 0.25, 3.0]),
    ),
    st.sampled_from([1, 60, 9999]),
)
@settings(max_examples=60, deadline=None)
def test_equals_the_equations(seed: int, n: int, q: int, given: SeqSlamSettings, entries: int) -> None:
    rng = np.random.default_rng(seed)
    references, queries = random_features(rng, n), random_features(rng, q)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectories, "_BLOCK_ENTRIES", entries)
        matches = match_seqslam(references, queries, given, ignore)
    hand = ByHand(references, queries, given)
    for t in range(q):
        costs = [hand.cost(t, e) for e in range(n)] if t >= given.length - 1 and n >= given.length else []
        if min(costs, default=math.inf) == math.inf:
            assert matches.reference[t] == NONE
            continue
        # Which of two ends it is may differ by rounding where they are as good.
        assert costs[matches.reference[t]] == pytest.approx(min(costs), abs=1e-4)
        assert matches.score[t] == pytest.approx(hand.uniqueness(costs, int(matches.reference[t])), abs=1e-3)


def test_a_shifted_copy_is_found_exactly() -> None:
    references = random_features(np.random.default_rng(0), 80)
    matches = match_seqslam(references, references[23:60], SeqSlamSettings(), ignore)
    assert matches.reference.tolist() == [NONE] * 9 + list(range(32, 60))
    assert matches.score[9:].min() > 0.3


@pytest.mark.parametrize("velocity", [0.8, 0.9, 1.0, 1.1, 1.2])
def test_other_speeds_are_recognized(velocity: float) -> None:
    """The queries come at another speed, under other light: every match ends where the query is."""
    rng = np.random.default_rng(1)
    road = Road(rng)
    references = road.at(np.arange(150.0))
    positions = 20.0 + velocity * np.arange(90)
    queries = 0.5 * road.at(positions) + rng.normal(scale=0.3, size=(90, 64)).astype(np.float32)
    given = SeqSlamSettings(length=20)
    matches = match_seqslam(references, queries, given, ignore)
    assert np.abs(matches.reference[19:] - positions[19:]).max() <= 1.5
    if velocity in {0.8, 1.2}:
        same_speed_only = match_seqslam(references, queries, replace(given, v_min=1.0, v_max=1.0), ignore)
        assert matches.score[19:].mean() > 1.2 * same_speed_only.score[19:].mean()


def test_speeds_beyond_the_range_are_not() -> None:
    road = Road(np.random.default_rng(2))
    positions = 10.0 + 2.0 * np.arange(60)
    references, queries = road.at(np.arange(150.0)), road.at(positions)
    slow = match_seqslam(references, queries, SeqSlamSettings(length=20), ignore)
    fast = match_seqslam(references, queries, SeqSlamSettings(length=20, v_max=2.2), ignore)
    assert np.abs(fast.reference[19:] - positions[19:]).max() <= 1.5
    assert slow.score[19:].mean() < 0.5 * fast.score[19:].mean()


def test_the_score_grows_as_the_second_best_grows_worse() -> None:
    """A place that comes twice is not unique at all; the more its second coming differs, the surer is the first."""
    rng = np.random.default_rng(3)
    road, noise = random_features(rng, 40), random_features(rng, 40)
    queries = road + 0.3 * random_features(rng, 40)
    # Near the ends of a coming the neighbourhoods differ, and with them the contrast.
    middle = slice(16, 35)
    scores = [
        match_seqslam(np.concatenate([road, road + share * noise]), queries, SeqSlamSettings(), ignore).score[middle]
        for share in (0.0, 0.3, 0.6, 1.0)
    ]
    assert scores[0] == pytest.approx(0.0, abs=1e-5)
    assert all(less.mean() < more.mean() for less, more in pairwise(scores))


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from([1, 2, 5]))
@settings(max_examples=60, deadline=None)
def test_scores_are_shares_whatever_comes(seed: int, n: int, different: int) -> None:
    """Also where frames repeat, so that differences are 0 and have no contrast."""
    rng = np.random.default_rng(seed)
    frames = random_features(rng, different, size=3)
    references, queries = frames[rng.integers(0, different, n)], frames[rng.integers(0, different, 12)]
    matches = match_seqslam(references, queries, SeqSlamSettings(length=4, window=6), ignore)
    assert matches.score.min() >= 0.0
    assert matches.score.max() < 1.0
    assert matches.matched[3:].all() == (n >= 4)


def test_without_contrast_nothing_is_unique() -> None:
    same = np.ones((40, 7), dtype=np.float32)
    matches = match_seqslam(same, same[:15], SeqSlamSettings(), ignore)
    assert matches.matched[9:].all()
    assert matches.score.max() == 0.0


def test_rounding_is_no_contrast() -> None:
    """References with the same numbers in another order are equally far from 0, but for the rounding of sums."""
    rng = np.random.default_rng(7)
    references = np.array([rng.permutation(np.linspace(0.1, 0.7, 2048)) for _ in range(40)], dtype=np.float32)
    matches = match_seqslam(references, np.zeros((15, 2048), dtype=np.float32), SeqSlamSettings(), ignore)
    assert matches.score.max() == 0.0


def test_two_perfect_matches_are_not_unique() -> None:
    """Both sums are as low as can be: every other reference is equally far."""
    references = np.ones((60, 5), dtype=np.float32)
    references[[10, 40]] = 0.0
    query = np.zeros((1, 5), dtype=np.float32)
    both = match_seqslam(references, query, SeqSlamSettings(length=1), ignore)
    assert (both.reference[0], both.score[0]) == (10, pytest.approx(0.0, abs=1e-5))
    references[10] = 1.0
    one = match_seqslam(references, query, SeqSlamSettings(length=1), ignore)
    assert (one.reference[0], one.score[0]) == (40, pytest.approx(1 - (math.sqrt(11) - math.sqrt(10)) / math.sqrt(11)))


def test_velocities_that_do_not_fit_are_left_out() -> None:
    """Of ten references, ten frames at twice the speed would need nineteen."""
    references = random_features(np.random.default_rng(8), 10)
    matches = match_seqslam(references, references, SeqSlamSettings(v_max=2.0), ignore)
    assert matches.reference[-1] == 9
    assert not match_seqslam(references, references, SeqSlamSettings(v_min=2.0, v_max=2.0), ignore).matched.any()


def test_differences_are_scipys() -> None:
    rng = np.random.default_rng(9)
    references, queries = random_features(rng, 37, size=50), random_features(rng, 11, size=50)
    assert differences(references, queries) == pytest.approx(cdist(queries, references, "cityblock") / 50, rel=1e-5)


def test_a_common_factor_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    references, queries = random_features(rng, 60), random_features(rng, 30)
    small = match_seqslam(references, queries, SeqSlamSettings(), ignore)
    large = match_seqslam(64 * references, 64 * queries, SeqSlamSettings(), ignore)
    assert small.reference.tolist() == large.reference.tolist()
    assert small.score == pytest.approx(large.score, abs=1e-5)


def test_other_layouts_of_memory_give_the_same() -> None:
    rng = np.random.default_rng(5)
    references, queries = random_features(rng, 40), random_features(rng, 20)
    plain = match_seqslam(references, queries, SeqSlamSettings(), ignore)
    other = match_seqslam(np.asfortranarray(references), np.repeat(queries, 2, axis=0)[::2], SeqSlamSettings(), ignore)
    assert plain.reference.tolist() == other.reference.tolist()
    assert plain.score.tolist() == other.score.tolist()


@pytest.mark.parametrize(("references", "queries"), [(9, 30), (30, 9), (0, 5), (30, 0)])
def test_of_too_few_frames_none_is_recognized(references: int, queries: int) -> None:
    features, done = random_features(np.random.default_rng(6), 30), list[int]()
    matches = match_seqslam(features[:references], features[:queries], SeqSlamSettings(), done.append)
    assert not matches.matched.any()
    assert done == [queries]
    assert isinstance(matches, Matches)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": 0}, "length of at least 1, got 0"),
        ({"window": 1}, "window of at least 2, got 1"),
        ({"v_min": 0.0}, "0 < v_min <= v_max, got 0.0"),
        ({"v_min": 1.3}, "0 < v_min <= v_max, got 1.3"),
        ({"v_max": math.inf}, "0 < v_min <= v_max, got 0.8 and inf"),
        ({"v_min": math.nan}, "0 < v_min <= v_max, got nan"),
        ({"v_step": 0.0}, "step above 0, got 0.0"),
        ({"v_step": math.nan}, "step above 0, got nan"),
        ({"v_step": 1e-9}, "at most 1000 velocities"),
    ],
)
def test_bad_settings_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SeqSlamSettings(), **change)  # type: ignore[arg-type]


def test_the_papers_velocities() -> None:
    """From 0.8 to 1.2 in steps of 0.1, both ends among them, though 0.8 + 4 * 0.1 is not quite 1.2."""
    ends = {line[-1] for line in SeqSlamSettings(length=11).trajectories()}
    assert ends == {8, 9, 10, 11, 12}
