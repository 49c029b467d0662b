"""Eq. 7 by hand."""

import numpy as np
import pytest

from smal.paper.objective import objective


@pytest.mark.parametrize("seed", range(4))
def test_objective_term_by_term(seed: int) -> None:
    """The sums of the paper, written out, for float32 input and a shorter last sequence."""
    rng = np.random.default_rng(seed)
    length = 3
    n = 11
    q = 4
    X = rng.standard_normal((6, n)).astype(np.float32)
    Y = rng.standard_normal((6, q)).astype(np.float32)
    W = rng.standard_normal((n, q)) * (rng.random((n, 1)) < 0.6)
    residuals = Y.astype(float) - X.astype(float) @ W
    expected = sum(np.sqrt(sum(residuals[k, i] ** 2 for k in range(6))) for i in range(q))
    expected += 0.3 * sum(np.sqrt((W[r] ** 2).sum()) for r in range(n))
    expected += 0.7 * sum(
        np.sqrt((W[j : j + length, i] ** 2).sum()) for j in range(0, n, length) for i in range(q)
    )
    assert objective(X, Y, W, length, 0.3, 0.7) == pytest.approx(expected, rel=1e-12)
