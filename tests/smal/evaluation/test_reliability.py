"""Scores that say how probable it is to be right, and known places against unknown ones."""

import numpy as np
import pytest

from smal.evaluation.ground_truth import Judgement
from smal.evaluation.reliability import Reliability, known_from_unknown


def judgement_of(score: np.ndarray, right: np.ndarray, findable: np.ndarray | None = None) -> Judgement:
    every = np.ones(len(score), dtype=bool)
    return Judgement(score, score > 0.0, right, every, every if findable is None else findable)


def test_scores_that_are_what_they_say_have_no_calibration_error() -> None:
    rng = np.random.default_rng(0)
    score = rng.random(100_000)
    right = rng.random(score.size) < score
    assert Reliability.of(judgement_of(score, right)).error < 0.01
    assert Reliability.of(judgement_of(np.sqrt(score), right)).error == pytest.approx(1 / 6, abs=0.01)
    assert Reliability.of(judgement_of(np.zeros(3), np.zeros(3, dtype=bool))).error == 0.0


def test_known_from_unknown_is_the_share_of_pairs() -> None:
    sure, findable = np.array([0.9, 0.4, 0.4, 0.1]), np.array([True, True, False, False])
    assert known_from_unknown(judgement_of(sure, findable, findable), sure) == pytest.approx(3.5 / 4)
    assert known_from_unknown(judgement_of(sure, findable), sure) is None
