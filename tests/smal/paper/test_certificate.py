"""The bounds that make a dual point feasible are never below the polar, and sharp enough to be of use."""

import numpy as np
import pytest

from smal.paper.matching.certificate import cheap_polar_bound, polar_bound, polar_bounds
from tests.smal.paper.matching import polar

LAMBDAS = [(0.3, 0.5), (1.0, 0.1), (0.05, 2.0), (0.4, 0.0), (0.0, 0.4)]


def penalty(W: np.ndarray, lambda1: float, lambda2: float) -> np.ndarray:
    """Of many W (k, l, q)."""
    return lambda1 * np.linalg.norm(W, axis=2).sum(axis=1) + lambda2 * np.linalg.norm(W, axis=1).sum(axis=1)


def largest_ratio(G: np.ndarray, lambda1: float, lambda2: float, rng: np.random.Generator) -> float:
    """Bound the polar of G from below: it is the maximum of <G, W> / penalty(W), climbed from many W."""
    W = rng.standard_normal((300, *G.shape)) * rng.integers(0, 2, (300, *G.shape)) + G * rng.random((300, 1, 1))
    best = 0.0
    for step in (0.0, 1.0, 0.3, 0.1, 0.03, 0.01):
        ratio = (W * G).sum(axis=(1, 2)) / np.maximum(penalty(W, lambda1, lambda2), 1e-300)
        best = max(best, float(ratio.max()))
        W = W[np.argsort(-ratio)[:30]]
        W = np.concatenate([W, (W[:, None] + step * rng.standard_normal((30, 9, *G.shape))).reshape(-1, *G.shape)])
    return best


def bound_of(G: np.ndarray, lambda1: float, lambda2: float, rounds: int, enough: float = 0.0) -> float:
    return polar_bound(G, lambda1, lambda2, G / (lambda1 + lambda2), np.empty_like(G), rounds, enough)


def all_bounds(
    G: np.ndarray, radii: np.ndarray, length: int, lambda1: float, lambda2: float, rounds: int, enough: float
) -> np.ndarray:
    starts = np.append(np.arange(0, len(G), length), len(G))
    bounds, U = np.empty(starts.size - 1), G.astype(np.float64) / (lambda1 + lambda2)
    polar_bounds(G, radii, starts, (lambda1, lambda2), (U, np.empty_like(U)), rounds, enough, bounds)
    return bounds


def sparse_block(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.standard_normal(shape) * np.exp(rng.standard_normal(shape)) * (rng.random(shape) < 0.7)


@pytest.mark.parametrize("lambdas", LAMBDAS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (3, 4), (6, 6)])
def test_bounds_are_above_the_exact_polar(lambdas: tuple[float, float], shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(hash((lambdas, shape)) % 2**32)
    for _ in range(3):
        G = sparse_block(rng, shape)
        exact = polar(G, *lambdas)
        assert largest_ratio(G, *lambdas, rng) <= exact * (1 + 1e-5) + 1e-6, "the test's own peer is wrong"
        assert cheap_polar_bound(G, *lambdas) >= exact * (1 - 1e-6) - 1e-8
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
        everything = all_bounds(G.astype(np.float32), np.zeros(5), 5, *lambdas, 100, 1.001)
        assert everything[0] <= 1.001


def test_blocks_where_the_cheap_bound_is_exact() -> None:
    assert cheap_polar_bound(np.eye(4), 0.3, 0.5) == pytest.approx(1 / 0.8)
    assert cheap_polar_bound(np.ones((2, 3)), 0.3, 0.5) == pytest.approx(polar(np.ones((2, 3)), 0.3, 0.5), rel=1e-6)
    assert cheap_polar_bound(np.zeros((2, 3)), 0.3, 0.5) <= 1e-100


@pytest.mark.parametrize("lambdas", LAMBDAS)
@pytest.mark.parametrize("size", [0.0, 1e-3, 0.1, 2.0])
@pytest.mark.parametrize("direction", ["random", "outward", "one row"])
def test_bounds_from_rounded_products_hold_for_the_true_ones(
    lambdas: tuple[float, float], size: float, direction: str
) -> None:
    rng = np.random.default_rng(int(1000 * size) + len(direction))
    length, q, n = 4, 5, 42  # the last sequence is shorter
    truth = sparse_block(rng, (n, q)) * np.repeat(10.0 ** rng.uniform(-1.5, 0.5, 11), length)[:n, None]
    radii = size * rng.random(n)
    if direction == "one row":
        radii[np.arange(n) % length > 0] = 0.0
    errors = rng.standard_normal((n, q)) if direction == "random" else -truth.copy()
    errors *= (radii / np.maximum(np.linalg.norm(errors, axis=1), 1e-300))[:, None]
    estimate = (truth + errors).astype(np.float32)
    radii = radii * (1 + 1e-6) + 1e-6 * np.linalg.norm(estimate, axis=1)  # float32 of the estimate
    for rounds, enough in ((0, 1.0), (8, 1.0), (8, 1.3)):
        bounds = all_bounds(estimate, radii, length, *lambdas, rounds, enough)
        assert bounds.shape == (11,)
        for block, bound in enumerate(bounds):
            G = truth[block * length : (block + 1) * length]
            assert bound >= largest_ratio(G, *lambdas, rng) * (1 - 1e-9)
            if block % 4 == 2 and rounds == 8 and enough == 1.0:
                assert bound >= polar(G, *lambdas) * (1 - 1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e-6, 1e6, 1e20])
def test_bounds_do_not_depend_on_the_scale(scale: float) -> None:
    """A norm is homogeneous; squares of float32 are not where they underflow."""
    G = np.random.default_rng(3).standard_normal((8, 5)).astype(np.float32)
    plain = all_bounds(G, np.full(8, 0.01), 4, 0.3, 0.5, 8, 1.0)
    radii, lambdas = np.full(8, 0.01 * scale), (0.3 * scale, 0.5 * scale)
    scaled = all_bounds((G * scale).astype(np.float32), radii, 4, *lambdas, 8, 1.0)
    np.testing.assert_allclose(scaled, plain, rtol=1e-4)
