"""What every method answers."""

import numpy as np
import pytest

from smal.place_recognition.matches import check_features


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
