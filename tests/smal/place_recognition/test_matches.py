"""What every method answers."""

import numpy as np
import pytest

from smal.place_recognition.matches import NONE, Matches, check_features


def test_matches_of_some_queries_and_above_a_score() -> None:
    matches = Matches(np.array([NONE, 0, 7]), np.array([0.0, 0.4, 1.0]))
    some = matches.of(np.array([2, 0]))
    assert (some.reference.tolist(), some.score.tolist()) == ([7, NONE], [1.0, 0.0])
    sure = matches.above(0.4)
    assert (sure.reference.tolist(), sure.score.tolist()) == ([NONE, NONE, 7], [0.0, 0.0, 1.0])


def test_features_that_do_not_fit_are_refused() -> None:
    features = np.ones((4, 3), dtype=np.float32)
    check_features(features, features[:0])
    with pytest.raises(ValueError, match=r"\(4, 3\) and \(4, 2\)"):
        check_features(features, features[:, :2])
    with pytest.raises(ValueError, match=r"\(4, 3\) and \(3,\)"):
        check_features(features, features[0])
    for value in (np.nan, np.inf, -np.inf):
        broken = features.copy()
        broken[2, 1] = value
        with pytest.raises(ValueError, match="queries contain NaN"):
            check_features(features, broken)
        with pytest.raises(ValueError, match="references contain NaN"):
            check_features(broken, features)
