"""Precision-recall against counting by hand, and what its intervals are worth."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, bootstrap


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


def all_answered(score: NDArray[np.float64], right: NDArray[np.bool_]) -> Judgement:
    yes = np.ones(score.shape, dtype=np.bool_)
    return Judgement(score, yes, right, yes, yes)


def by_hand(judgement: Judgement) -> list[tuple[float, float, float]]:
    """Return (recall, precision, threshold) for each score, highest first, counting all queries each time."""
    j, points = judgement, []
    queries = [i for i in range(j.score.size) if j.judged[i]]
    for threshold in sorted({j.score[i] for i in queries if j.answered[i]}, reverse=True):
        answers = [i for i in queries if j.answered[i] and j.score[i] >= threshold]
        right = sum(j.right[i] for i in answers)
        points.append((right / sum(j.findable), right / len(answers), threshold))
    return points


def taken(judgement: Judgement, queries: NDArray[np.int64]) -> Judgement:
    j = judgement
    return Judgement(j.score[queries], j.answered[queries], j.right[queries], j.judged[queries], j.findable[queries])


@given(judgements())
@settings(deadline=None)
def test_equals_counting_by_hand(judgement: Judgement) -> None:
    curve, points = PrecisionRecall.of(judgement), by_hand(judgement)
    assert np.column_stack([curve.recall, curve.precision, curve.threshold]).tolist() == [list(p) for p in points]
    area, before = 0.0, 0.0
    for recall, precision, _ in points:
        area += precision * (recall - before)
        before = recall
    assert curve.auc == pytest.approx(area)
    assert curve.recall_at_100_precision == max((r for r, p, _ in points if p == 1.0), default=0.0)


def test_perfect_useless_and_silent_methods() -> None:
    rng = np.random.default_rng(0)
    right = rng.random(20000) < 0.3
    perfect = PrecisionRecall.of(all_answered(rng.random(50), np.ones(50, dtype=np.bool_)))
    assert (perfect.auc, perfect.recall_at_100_precision) == (1.0, 1.0)
    # Scores that say nothing: precision is 0.3 at every recall up to 0.3.
    assert PrecisionRecall.of(all_answered(rng.random(20000), right)).auc == pytest.approx(0.09, abs=0.005)
    assert PrecisionRecall.of(all_answered(right.astype(float), right)).auc == pytest.approx(right.mean())
    no = np.zeros(3, dtype=np.bool_)
    silent = PrecisionRecall.of(Judgement(np.zeros(3), no, no, ~no, ~no))
    assert (silent.auc, silent.recall_at_100_precision, silent.recall.size) == (0.0, 0.0, 0)


def test_nothing_to_find_is_refused() -> None:
    no = np.zeros(3, dtype=np.bool_)
    for function in (PrecisionRecall.of, lambda j: bootstrap(j, 1)):
        with pytest.raises(ValueError, match="no query has anything to find"):
            function(Judgement(np.zeros(3), ~no, no, ~no, no))


@given(judgements(), st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_a_query_counts_as_often_as_it_is_drawn(judgement: Judgement, seed: int) -> None:
    times = np.random.default_rng(seed).integers(0, 4, judgement.judged.size)
    assume((times * judgement.findable).any())
    curve = PrecisionRecall.of(judgement, times)
    drawn = PrecisionRecall.of(taken(judgement, np.repeat(np.arange(times.size), times)))
    np.testing.assert_allclose([curve.recall, curve.precision], [drawn.recall, drawn.precision])


@given(judgements(), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_bootstrap_draws_blocks_that_follow_each_other(judgement: Judgement, seed: int) -> None:
    """A block as long as the traverse is all of it, wherever it begins."""
    curve = PrecisionRecall.of(judgement)
    figures = bootstrap(judgement, int(judgement.judged.sum()), resamples=5, seed=seed)
    np.testing.assert_allclose(figures, [(curve.auc, curve.recall_at_100_precision)] * 5)
