"""Products of templates with a few vectors are as exact as they claim, for every shape."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.matching.narrow_product import narrow_product, narrow_product_and_squares, rounding

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
    check(X, T, narrow_product(X, T))
    products, squares = narrow_product_and_squares(X, T)
    check(X, T, products)
    exact = np.square(X.astype(np.float64)).sum(axis=1)
    assert (np.abs(squares - exact) <= rounding(m) * exact).all()
    small = rng.integers(-127, 128, (n, m)).astype(np.int8)
    check(small, T, narrow_product(small, T))


def test_error_bound_of_long_sums() -> None:
    """Adding 0.1 a million times in order would be off by percents."""
    X = np.full((5, 200_003), 0.1, dtype=np.float32)
    T = np.full((6, 200_003), 0.1, dtype=np.float32)
    check(X, T, narrow_product(X, T))
    check(X, T, narrow_product_and_squares(X, T)[0])


def test_rounding() -> None:
    assert 4096 * 2.0**-24 <= rounding(4096) <= 1.001 * 4096 * 2.0**-24
    assert rounding(1) > 2.0**-24
    assert rounding(2**24) == np.inf


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("row", [0, 3, 8, 12])
def test_what_is_not_finite_shows_in_the_squares(bad: float, row: int) -> None:
    X, T = np.ones((13, 37), np.float32), np.zeros((5, 37), np.float32)
    X[row, 36] = bad
    for vectors in (T, T[:1], T[:2]):
        squares = narrow_product_and_squares(X, vectors)[1]
        assert np.flatnonzero(~np.isfinite(squares)).tolist() == [row]


def test_a_part_of_the_templates() -> None:
    rng = np.random.default_rng(0)
    X, T = rng.standard_normal((40, 50)).astype(np.float32), rng.standard_normal((7, 50)).astype(np.float32)
    np.testing.assert_allclose(narrow_product(X[5:19], T), (X @ T.T)[5:19], rtol=1e-4, atol=1e-4)
    assert narrow_product(X[:0], T).shape == (0, 7)
