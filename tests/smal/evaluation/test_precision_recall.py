"""Answers against a truth: precision and recall by hand, and calibration of scores."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.evaluation.ground_truth import IntervalTruth, Judgement, judge_by_poses
from smal.evaluation.precision_recall import PrecisionRecall, bootstrap
from smal.evaluation.reliability import Reliability, known_from_unknown
from smal.place_recognition import Matches


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 3.0), st.floats(1.0, 179.0))
@settings(max_examples=15)
def test_poses_are_near_and_look_the_same_way(
    seed: int, distance_m: float, angle_deg: float
) -> None:
    rng = np.random.default_rng(seed)
    references, queries = (
        np.column_stack([rng.uniform(0, 4, (n, 2)), rng.uniform(-20, 20, n)]) for n in (30, 300)
    )
    right = np.zeros((300, 30), dtype=bool)
    for j in range(30):
        judged = judge_by_poses(
            Matches(np.full(300, j), np.ones(300), np.zeros(300)),
            references,
            queries,
            distance_m,
            angle_deg,
        )
        right[:, j] = judged.right
        assert judged.judged.all()
    assert judged.findable.tolist() == right.any(axis=1).tolist()
    for i in range(0, 300, 30):
        for j in range(30):
            (x, y, a) = queries[i]
            (u, v, b) = references[j]
            cos = math.cos(a) * math.cos(b) + math.sin(a) * math.sin(b)
            apart_deg = math.degrees(math.acos(max(-1.0, min(1.0, cos))))
            assert right[i, j] == (
                math.dist((x, y), (u, v)) <= distance_m and apart_deg <= angle_deg
            )


def test_truth_judges_answers() -> None:
    """Right; wrong; not judged; nothing to find; no answer; right at the second of two intervals."""
    intervals = np.array([[0, 2, 4], [1, 2, 4], [4, 0, 9], [5, 1, 2], [5, 7, 8]]).T
    truth = IntervalTruth(*intervals, np.array([1, 1, 0, 1, 1, 1], bool))
    matches = Matches(
        np.array([4, 5, 3, 3, -1, 7]), np.array([5.0, 4.0, 3.0, 2.0, 0.0, 1.0]), np.zeros(6)
    )
    judgement = truth.judge(matches)
    assert judgement.right.tolist() == [True, False, False, False, False, True]
    assert judgement.answered.tolist() == [True, True, True, True, False, True]
    assert judgement.findable.tolist() == [True, True, False, False, True, True]


@st.composite
def judgements(draw: st.DrawFn) -> Judgement:
    """Draw queries of every kind, with scores of which some are equal."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 40))
    judged = rng.random(count) < 0.8
    findable = judged & (rng.random(count) < 0.8)
    assume(findable.any())
    answered = rng.random(count) < draw(st.sampled_from([0.0, 0.5, 1.0]))
    right = answered & findable & (rng.random(count) < draw(st.sampled_from([0.2, 0.8, 1.0])))
    score = rng.integers(-5, draw(st.sampled_from([-4, 0, 1000])), count) / 7.0
    return Judgement(score, answered, right, judged, findable)


def by_hand(judgement: Judgement) -> list[tuple[float, float, float]]:
    """Return (recall, precision, threshold) for each score, highest first, counting all queries each time."""
    j = judgement
    points = []
    queries = [i for i in range(j.score.size) if j.judged[i]]
    for threshold in sorted({j.score[i] for i in queries if j.answered[i]}, reverse=True):
        answers = [i for i in queries if j.answered[i] and j.score[i] >= threshold]
        right = sum(j.right[i] for i in answers)
        points.append((right / sum(j.findable), right / len(answers), threshold))
    return points


def taken(judgement: Judgement, queries: NDArray[np.int64]) -> Judgement:
    j = judgement
    arrays = (j.score, j.answered, j.right, j.judged, j.findable)
    return Judgement(*(one[queries] for one in arrays))


@given(judgements())
def test_equals_counting_by_hand(judgement: Judgement) -> None:
    curve = PrecisionRecall.of(judgement)
    points = by_hand(judgement)
    assert np.column_stack([curve.recall, curve.precision, curve.threshold]).tolist() == [
        list(p) for p in points
    ]
    area = 0.0
    before = 0.0
    for recall, precision, _ in points:
        area += precision * (recall - before)
        before = recall
    assert curve.auc == pytest.approx(area)
    assert curve.recall_at_100_precision == max((r for r, p, _ in points if p == 1.0), default=0.0)


@given(judgements(), st.integers(0, 1000))
@settings(max_examples=50)
def test_query_counts_as_often_as_it_is_drawn(judgement: Judgement, seed: int) -> None:
    times = np.random.default_rng(seed).integers(0, 4, judgement.judged.size)
    assume((times * judgement.findable).any())
    curve = PrecisionRecall.of(judgement, times)
    drawn = PrecisionRecall.of(taken(judgement, np.repeat(np.arange(times.size), times)))
    np.testing.assert_allclose([curve.recall, curve.precision], [drawn.recall, drawn.precision])


@given(judgements(), st.integers(0, 1000))
@settings(max_examples=20)
def test_bootstrap_draws_consecutive_blocks(judgement: Judgement, seed: int) -> None:
    """A block as long as the traverse is all of it, wherever it begins."""
    curve = PrecisionRecall.of(judgement)
    figures = bootstrap(judgement, int(judgement.judged.sum()), resamples=5, seed=seed)
    np.testing.assert_allclose(figures, [(curve.auc, curve.recall_at_100_precision)] * 5)


def judgement_of(
    score: np.ndarray, right: np.ndarray, findable: np.ndarray | None = None
) -> Judgement:
    every = np.ones(len(score), dtype=bool)
    return Judgement(score, score > 0.0, right, every, every if findable is None else findable)


def test_calibrated_scores_have_no_calibration_error() -> None:
    rng = np.random.default_rng(0)
    score = rng.random(100_000)
    right = rng.random(score.size) < score
    assert Reliability.of(judgement_of(score, right)).error < 0.01
    assert Reliability.of(judgement_of(np.sqrt(score), right)).error == pytest.approx(
        1 / 6, abs=0.01
    )
    assert Reliability.of(judgement_of(np.zeros(3), np.zeros(3, dtype=bool))).error == 0.0


def test_known_from_unknown_is_the_share_of_pairs() -> None:
    sure = np.array([0.9, 0.4, 0.4, 0.1])
    findable = np.array([True, True, False, False])
    assert known_from_unknown(judgement_of(sure, findable, findable), sure) == pytest.approx(
        3.5 / 4
    )
    assert known_from_unknown(judgement_of(sure, findable), sure) is None
