"""What state matching cannot answer it refuses, in words that say why."""

import numpy as np
import pytest

from smal import solve
from tests.smal.worlds import matching_problem

BAD = [np.nan, np.inf, -np.inf]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("column", [0, 199, 399])
@pytest.mark.parametrize("lambda1", [0.1, 20.0])
def test_templates_that_are_not_finite(bad: float, column: int, lambda1: float) -> None:
    """Anywhere: where the solution looks, and where it does not."""
    X, Y = matching_problem(0, blocks=100, length=4)
    X[-1, column] = bad
    for templates in (X, np.ascontiguousarray(X), X.astype(np.float64), np.ascontiguousarray(X, dtype=np.float64)):
        with pytest.raises(ValueError, match="NaN or infinity"), np.errstate(all="ignore"):
            solve(templates, Y, 4, lambda1, 0.1)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("frame", [0, 3])
def test_queries_that_are_not_finite(bad: float, frame: int) -> None:
    X, Y = matching_problem(0, blocks=100, length=4)
    Y[-1, frame] = bad
    for query in (Y, np.ascontiguousarray(Y), Y.astype(np.float64)):
        with pytest.raises(ValueError, match="query contains NaN or infinity"), np.errstate(all="ignore"):
            solve(X, query, 4, 0.1, 0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sequence_length": 0}, "sequence_length"),
        ({"lambda1": -1.0}, "lambda1"),
        ({"lambda1": 0.0, "lambda2": 0.0}, "not both 0"),
        ({"lambda2": np.nan}, "lambda2"),
        ({"lambda2": np.inf}, "lambda2"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": 1.0}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"query": np.ones((3, 2), np.float32)}, "do not fit"),
        ({"query": np.ones(60, np.float32)}, "do not fit"),
        ({"templates": np.ones(60, np.float32)}, "matrix"),
        ({"templates": np.ones((60, 0), np.float32)}, "at least one template"),
        ({"templates": np.ones((60, 2), np.int64)}, "floating point"),
    ],
)
def test_bad_input(change: dict, words: str) -> None:
    X, Y = matching_problem(0, blocks=3, length=2)
    arguments = {"templates": X, "query": Y, "sequence_length": 2, "lambda1": 0.1, "lambda2": 0.1} | change
    with pytest.raises(ValueError, match=words):
        solve(**arguments)
