"""What every method answers."""

import numpy as np
import pytest

from smal.place_recognition.matches import NONE, Matches, check_features


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


def test_the_surest_have_the_precision_that_is_asked_for() -> None:
    """Of scores .99, .9, .9 and .5 the first three are right in 93 of 100 cases."""
    matches = Matches(np.arange(5), np.array([0.9, 0.5, 0.99, 0.9, 0.0]), np.zeros(5))
    assert matches.surest(0.93).matched.tolist() == [True, False, True, True, False]
    assert matches.surest(0.95).reference.tolist() == [NONE, NONE, 2, NONE, NONE]
    assert not matches.surest(0.999).matched.any()
    assert not Matches.none(3).surest(0.5).matched.any()
