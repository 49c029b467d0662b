"""Intervals of success rates."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smal.evaluation.success import wilson_interval


def test_known_values() -> None:
    assert wilson_interval(18, 20) == pytest.approx((0.6990, 0.9721), abs=1e-4)
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == 1.0


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_contains_the_rate(case: tuple[int, int]) -> None:
    successes, runs = case
    low, high = wilson_interval(successes, runs)
    assert 0.0 <= low <= successes / runs <= high <= 1.0
    assert low < high


@pytest.mark.parametrize("case", [(1, 0), (-1, 5), (6, 5)])
def test_bad_counts_are_refused(case: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="success rate"):
        wilson_interval(*case)
