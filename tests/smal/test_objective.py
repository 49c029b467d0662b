"""Eq. 7 and the polar of its penalty, by hand."""

import numpy as np
import pytest

from smal.certificate import cheap_polar_bounds, polar_bounds
from smal.objective import l21_norm, objective, s1_norm


def test_norms_by_hand() -> None:
    W = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 5.0]])
    assert l21_norm(W) == pytest.approx(10.0)
    assert s1_norm(W, 2) == pytest.approx(3 + 4 + 0 + 5)
    assert s1_norm(W, 3) == pytest.approx(3 + np.hypot(4, 5))
    assert s1_norm(np.zeros((0, 2)), 3) == 0.0
    with pytest.raises(ValueError, match="sequence_length"):
        s1_norm(W, 0)


def test_objective_by_hand() -> None:
    X, Y = np.eye(2), np.array([[1.0], [2.0]])
    W = np.array([[1.0], [0.0]])
    assert objective(X, Y, W, 1, 0.5, 0.25) == pytest.approx(2.0 + 0.5 + 0.25)


@pytest.mark.parametrize("seed", range(5))
def test_polar_bounds_are_upper_bounds(seed: int) -> None:
    """The polar is the maximum of <G, W> / penalty(W): no W may exceed the bounds."""
    rng = np.random.default_rng(seed)
    G = rng.standard_normal((4, 3, 5))
    lambda1, lambda2 = rng.uniform(0.1, 1.0, 2)
    cheap = cheap_polar_bounds(G, lambda1, lambda2)
    sharp = polar_bounds(G / cheap[:, None, None], lambda1, lambda2, G, 20) * cheap
    assert (sharp <= cheap * (1 + 1e-12)).all()
    for block in range(4):
        W = rng.standard_normal((2000, 3, 5)) * rng.integers(0, 2, (2000, 3, 5)) + G[block]
        penalty = lambda1 * np.linalg.norm(W, axis=2).sum(axis=1) + lambda2 * np.linalg.norm(W, axis=1).sum(axis=1)
        assert ((W * G[block]).sum(axis=(1, 2)) <= sharp[block] * penalty * (1 + 1e-9)).all()
