"""Near-copies of templates and small penalties leave so little of Eq. 7 that rounding could take its place."""

import numpy as np
import pytest

from smal import solve
from tests.smal.paper.matching import Problem
from tests.smal.worlds import unit

TOLERANCE = 1e-3
#: The solver finds residuals from inner products, which are accurate to about 1e-15 of a query frame's square. So each
#: residual is off by up to the root of that, whatever order a BLAS sums in; the factor 2 covers the sums of its terms.
RESIDUAL_ERROR = 2.0 * 1e-15**0.5


def near_copy(seed: int, lambda_: float, noise: float) -> tuple[Problem, int]:
    """Query a template sequence that noise was added to, and tell where it starts."""
    rng = np.random.default_rng(seed)
    length = int(rng.choice([1, 2, 3, 5]))
    size = int(rng.choice([40, 60, 100]))
    count = length * int(rng.integers(3, 20))
    X = np.asfortranarray(unit(rng.standard_normal((count, size))).T, dtype=np.float32)
    start = length * int(rng.integers(0, count // length))
    Y = X[:, start : start + length] + noise * unit(rng.standard_normal((length, size))).T
    return Problem(X, np.asfortranarray(Y), length, lambda_, lambda_), start


def extended(problem: Problem, active: np.ndarray, weights: np.ndarray) -> np.longdouble:
    """Eq. 7 in extended precision, at the rows of W that are not zero."""
    X, Y, W = (array.astype(np.longdouble) for array in (problem.X[:, active], problem.Y, weights))
    of_block = (active // problem.length)[:, None] == np.unique(active // problem.length)
    squares = of_block.T.astype(np.longdouble) @ W**2
    value = (
        np.sqrt(((Y - X @ W) ** 2).sum(axis=0)).sum()
        + problem.lambda1 * np.sqrt((W**2).sum(axis=1)).sum()
    )
    return np.longdouble(value + problem.lambda2 * np.sqrt(squares).sum())


@pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="this machine has no extended precision"
)
@pytest.mark.parametrize(("lambda_", "noise"), [(1e-6, 0.0), (1e-4, 1e-5), (1e-3, 0.0)])
def test_gap_is_true_and_small_when_rounding_is_large(lambda_: float, noise: float) -> None:
    """A gap of 1 is always true, so the gap must also be as small as the accuracy of residuals permits."""
    problem, start = near_copy(0, lambda_, noise)
    copied = np.arange(start, start + problem.length)
    best = extended(problem, copied, np.eye(problem.length))
    solution = solve(problem.X, problem.Y, *problem.parameters, tolerance=TOLERANCE)
    value = extended(problem, solution.active, solution.active_weights)
    assert value <= solution.objective * (1.0 + 1e-15)
    assert 1.0 - min(best, value) / value <= solution.duality_gap
    assert solution.duality_gap <= TOLERANCE + problem.length * RESIDUAL_ERROR / float(value)
