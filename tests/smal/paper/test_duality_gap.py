"""The bounds that make a dual point feasible are never below the polar, and sharp enough to be of use."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.paper.duality_gap import polar_bounds, quick_bounds, rounding
from tests.smal.paper.matching import polar

LAMBDAS = [(0.3, 0.5), (1.0, 0.1), (0.05, 2.0), (0.4, 0.0), (0.0, 0.4)]


def penalty(W: np.ndarray, lambda1: float, lambda2: float) -> np.ndarray:
    """Of many W (k, l, q)."""
    return lambda1 * np.linalg.norm(W, axis=2).sum(axis=1) + lambda2 * np.linalg.norm(
        W, axis=1
    ).sum(axis=1)


def largest_ratio(G: np.ndarray, lambda1: float, lambda2: float, rng: np.random.Generator) -> float:
    """Bound the polar of G from below: it is the maximum of <G, W> / penalty(W), climbed from many W."""
    W = rng.standard_normal((300, *G.shape)) * rng.integers(0, 2, (300, *G.shape)) + G * rng.random(
        (300, 1, 1)
    )
    best = 0.0
    for step in (0.0, 1.0, 0.3, 0.1, 0.03, 0.01):
        ratio = (W * G).sum(axis=(1, 2)) / np.maximum(penalty(W, lambda1, lambda2), 1e-300)
        best = max(best, float(ratio.max()))
        W = W[np.argsort(-ratio)[:30]]
        W = np.concatenate(
            [W, (W[:, None] + step * rng.standard_normal((30, 9, *G.shape))).reshape(-1, *G.shape)]
        )
    return best


def bound_of(
    G: np.ndarray, lambda1: float, lambda2: float, rounds: int, enough: float = 0.0
) -> float:
    bounds, _ = polar_bounds(
        G[None], lambda1, lambda2, G[None] / (lambda1 + lambda2), rounds, enough
    )
    return float(bounds[0])


def sparse_block(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return (
        rng.standard_normal(shape) * np.exp(rng.standard_normal(shape)) * (rng.random(shape) < 0.7)
    )


@pytest.mark.parametrize("lambdas", LAMBDAS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (3, 4), (6, 6)])
def test_bounds_are_above_the_exact_polar(
    lambdas: tuple[float, float], shape: tuple[int, int]
) -> None:
    rng = np.random.default_rng(hash((lambdas, shape)) % 2**32)
    for _ in range(3):
        G = sparse_block(rng, shape)
        exact = polar(G, *lambdas)
        assert largest_ratio(G, *lambdas, rng) <= exact * (1 + 1e-5) + 1e-6, (
            "the test's own peer is wrong"
        )
        assert quick_bounds(G[None], *lambdas)[0] >= exact * (1 - 1e-6) - 1e-8
        for rounds in (0, 1, 8):
            assert bound_of(G, *lambdas, rounds) >= exact * (1 - 1e-6) - 1e-8


@pytest.mark.parametrize("lambdas", LAMBDAS)
def test_a_block_inside_the_dual_set_is_recognized(lambdas: tuple[float, float]) -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        G = sparse_block(rng, (5, 5))
        G *= 0.98 / max(polar(G, *lambdas), 1e-9)
        assert bound_of(G, *lambdas, 100, 1.001) <= 1.001
        assert bound_of(1.05 * G, *lambdas, 100, 1.001) > 1.001


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e-6, 1e6, 1e20])
def test_bounds_do_not_depend_on_the_scale(scale: float) -> None:
    blocks = np.random.default_rng(3).standard_normal((2, 4, 5)).astype(np.float32)
    scaled = quick_bounds((blocks * scale).astype(np.float32), 0.3 * scale, 0.5 * scale)
    np.testing.assert_allclose(scaled, quick_bounds(blocks, 0.3, 0.5), rtol=1e-4)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    shape=st.tuples(st.integers(1, 23), st.integers(1, 700), st.integers(1, 13)),
    seed=st.integers(0, 2**31),
    decades=st.sampled_from([0, 3, 8]),
    positive=st.booleans(),
)
def test_products_are_as_exact_as_rounding_says(
    shape: tuple[int, int, int], seed: int, decades: int, positive: bool
) -> None:
    n, m, q = shape
    rng = np.random.default_rng(seed)
    X, T = (
        rng.standard_normal((k, m)) * 10.0 ** rng.uniform(-decades, decades, (k, m)) for k in (n, q)
    )
    if positive:  # nothing cancels, so every rounding counts
        X = np.abs(X)
        T = np.abs(T)
    X = X.astype(np.float32)
    T = T.astype(np.float32)
    exact = X.astype(np.float64) @ T.T.astype(np.float64)
    allowed = rounding(m, np.float32) * np.outer(
        np.linalg.norm(X, axis=1), np.linalg.norm(T, axis=1)
    )
    assert (np.abs(X @ T.T - exact) <= allowed * (1 + 1e-6)).all()
