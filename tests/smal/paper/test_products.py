"""Products of templates with a few vectors are as exact as they claim, for every shape."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal import solve
from smal.paper.matching import products
from smal.paper.matching.products import Known, narrow_product, rounding
from tests.smal.worlds import matching_problem

shapes = st.tuples(st.integers(1, 23), st.integers(1, 700), st.integers(1, 13))


def check(rows: np.ndarray, vectors: np.ndarray, products: np.ndarray) -> None:
    X, T = rows.astype(np.float64), vectors.astype(np.float64)
    allowed = rounding(X.shape[1]) * np.outer(np.linalg.norm(X, axis=1), np.linalg.norm(T, axis=1))
    assert products.shape == (len(X), len(T))
    assert products.dtype == np.float32
    assert (np.abs(products - X @ T.T) <= allowed).all()


@settings(max_examples=80, deadline=None, derandomize=True)
@given(shape=shapes, seed=st.integers(0, 2**31), decades=st.sampled_from([0, 3, 8]), positive=st.booleans())
def test_error_bound(shape: tuple[int, int, int], seed: int, decades: int, positive: bool) -> None:
    n, m, q = shape
    rng = np.random.default_rng(seed)
    X, T = rng.standard_normal((n, m)), rng.standard_normal((q, m))
    X *= 10.0 ** rng.uniform(-decades, decades, X.shape)
    T *= 10.0 ** rng.uniform(-decades, decades, T.shape)
    if positive:  # nothing cancels, so every rounding counts
        X, T = np.abs(X), np.abs(T)
    X, T = X.astype(np.float32), T.astype(np.float32)
    chosen = np.flatnonzero(rng.random(n) < 0.7)
    check(X[chosen], T, narrow_product(X, chosen, T))
    check(X, T, narrow_product(X, np.arange(n), T))


def test_error_bound_of_long_sums() -> None:
    """Adding 0.1 a million times in order would be off by percents."""
    X = np.full((5, 200_003), 0.1, dtype=np.float32)
    T = np.full((6, 200_003), 0.1, dtype=np.float32)
    check(X, T, narrow_product(X, np.arange(5), T))


def test_rounding() -> None:
    assert 4096 * 2.0**-24 <= rounding(4096) <= 1.001 * 4096 * 2.0**-24
    assert rounding(1) > 2.0**-24
    assert rounding(2**24) == np.inf


LENGTH = 5


def bound_from_wrong_products(seed: int, noise: float, scale: float) -> tuple[float, float]:
    """Return by how much the bound from known products is below the optimum, as a share of it, and the gap.

    They are as wrong as rounding may make them, each in the direction that a seed says.
    """
    X, Y = matching_problem(seed % 1000, blocks=12, length=LENGTH, size=100, noise=noise, mixed=3)
    rng, x, y = np.random.default_rng(seed), np.linalg.norm(X, axis=0), np.linalg.norm(Y, axis=0)
    wrong = rng.choice([-1.0, 1.0], (x.size, x.size))
    wrong = np.triu(wrong) + np.triu(wrong, 1).T
    gram = X.T.astype(np.float64) @ X + 0.9 * rounding(100) * np.outer(x, x) * wrong
    correlations = X.T.astype(np.float64) @ Y + 0.9 * rounding(100) * np.outer(x, y) * rng.choice([-1, 1], (x.size, 5))
    known = Known(correlations.astype(np.float32), gram.astype(np.float32))
    found = solve(X, Y, LENGTH, scale, scale, 1e-5, known)
    best = solve(X, Y, LENGTH, scale, scale, 1e-7).objective
    return 1.0 - found.objective * (1.0 - found.duality_gap) / best, found.duality_gap


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31), noise=st.sampled_from([0.0, 0.05, 0.5]), scale=st.sampled_from([0.1, 0.3]))
def test_no_bound_is_above_the_optimum_however_known_products_are_rounded(
    seed: int, noise: float, scale: float
) -> None:
    below, gap = bound_from_wrong_products(seed, noise, scale)
    assert below >= -1e-9
    assert gap <= 1e-5


def test_known_products_save_the_pass_over_the_templates(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_pass(*_: object) -> None:
        raise AssertionError("the templates were multiplied")

    monkeypatch.setattr(products, "narrow_product", no_pass)
    X, Y = matching_problem(1, blocks=12, length=LENGTH, size=100, noise=0.5, mixed=3)
    assert solve(X, Y, LENGTH, 0.3, 0.3, 1e-3, Known(X.T @ Y, X.T @ X)).converged
    with pytest.raises(AssertionError, match="were multiplied"):
        solve(X, Y, LENGTH, 0.3, 0.3, 1e-3)
