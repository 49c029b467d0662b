"""The rounded copy of the templates: bounds that hold, and answers that are those of the templates themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal import TemplateIndex, solve
from tests.smal.matching import check, check_bounds, structured
from tests.smal.worlds import matching_problem, unit

KINDS = ["unit", "dynamic range", "constant", "zero", "one hot", "outlier", "integers", "alternating", "tiny"]


def templates_of(kind: str, rng: np.random.Generator, m: int) -> np.ndarray:
    """Templates (m, 9) that are hard to round."""
    X = unit(rng.standard_normal((9, m))).T
    if kind == "dynamic range":
        X = X * 10.0 ** rng.uniform(-12, 6, X.shape)
    elif kind == "constant":
        X = np.full((m, 9), 0.3)
    elif kind == "zero":
        X[:, ::2] = 0.0
    elif kind == "one hot":
        X = np.zeros((m, 9))
        X[rng.integers(0, m, 9), np.arange(9)] = rng.standard_normal(9)
    elif kind == "outlier":
        X[0] = 1e4
    elif kind == "integers":
        X = rng.integers(-127, 128, X.shape).astype(float)
    elif kind == "alternating":  # every entry is half a step off
        X = np.where(np.arange(m)[:, None] % 2, 126.5, -63.5) * np.ones(9)
    elif kind == "tiny":
        X = X * 1e-15
    return X.astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31), m=st.integers(1, 400), q=st.integers(1, 8), aligned=st.booleans())
def test_estimates_are_within_their_radii(kind: str, seed: int, m: int, q: int, aligned: bool) -> None:
    rng = np.random.default_rng(seed)
    X = templates_of(kind, rng, m)
    index = TemplateIndex(X)
    theta = rng.standard_normal((q, m)) * 10.0 ** rng.uniform(-3, 3)
    if aligned:  # along what rounding loses, where the error is largest
        scale = np.abs(X).max(axis=0).astype(float) / 127.0
        lost = (X - scale * np.rint(X / np.maximum(scale, 1e-300))).T
        theta = np.resize(lost, (q, m)) if lost.any() else theta
    truth = X.T.astype(np.float64) @ theta.T
    chosen = np.flatnonzero(rng.random(9) < 0.5)
    for columns, true in ((None, truth), (chosen, truth[chosen])):
        found = index.correlate(theta, columns)
        assert (np.linalg.norm(found.values - true, axis=1) <= found.radii * (1 + 1e-12)).all()


def test_radii_rule_something_out() -> None:
    rng = np.random.default_rng(1)
    index = TemplateIndex(unit(rng.standard_normal((50, 500))).T)
    theta = unit(rng.standard_normal((1, 500)))
    assert index.correlate(theta).radii.max() < 0.02
    np.testing.assert_allclose(index.lengths, 1.0, rtol=1e-5)


def test_shapes_and_memory() -> None:
    X, _ = matching_problem(0, blocks=5, length=4, size=2048)
    index = TemplateIndex(X)
    assert index.shape == (2048, 20)
    assert np.shares_memory(index.templates, X)
    assert np.array_equal(TemplateIndex(np.ascontiguousarray(X)).templates, X)
    assert np.array_equal(TemplateIndex(X.astype(np.float64)).templates, X)
    assert index.nbytes <= 20 * (5.125 * 2048 + 24)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", [0, 7, 14])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_not_finite_is_refused(bad: float, column: int, kind: type) -> None:
    X, Y = matching_problem(0, blocks=5, length=3)
    X[-1, column] = bad
    with pytest.raises(ValueError, match="NaN or infinity"), np.errstate(all="ignore"):
        TemplateIndex(X.astype(kind))
    Y[-1, 2] = bad
    with pytest.raises(ValueError, match="NaN or infinity"), np.errstate(all="ignore"):
        solve(TemplateIndex(np.ones((60, 3), np.float32)), Y, 3, 0.1, 0.1)


def test_wrong_shapes_and_types_are_refused() -> None:
    with pytest.raises(ValueError, match="floating-point matrix"):
        TemplateIndex(np.ones((3, 4), np.int64))
    with pytest.raises(ValueError, match="floating-point matrix"):
        TemplateIndex(np.ones(3))
    index = TemplateIndex(np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match="do not fit"):
        solve(index, np.ones((4, 2)), 2, 0.1, 0.1)
    with pytest.raises(ValueError, match="at least one template"):
        solve(TemplateIndex(np.ones((3, 0), np.float32)), np.ones((3, 2)), 2, 0.1, 0.1)


@pytest.mark.parametrize("x_power", [-6, -3, 0, 3, 6])
@pytest.mark.parametrize("y_power", [-6, 0, 6])
def test_scales(x_power: int, y_power: int) -> None:
    X, Y = matching_problem(1, blocks=4, length=3)
    plain = solve(X, Y, 3, 0.2, 0.2, tolerance=1e-6)
    scale = 10.0**x_power
    Xs, Ys = (X * scale).astype(np.float32), (Y * 10.0**y_power).astype(np.float32)
    scaled = solve(TemplateIndex(Xs), Ys, 3, 0.2 * scale, 0.2 * scale, tolerance=1e-6)
    assert scaled.converged
    assert scaled.objective == pytest.approx(plain.objective * 10.0**y_power, rel=3e-6)
    np.testing.assert_allclose(scaled.weights * 10.0 ** (x_power - y_power), plain.weights, atol=2e-3)


def test_one_index_for_many_queries() -> None:
    problems = [structured("mixture", seed) for seed in range(6)]
    for problem in problems:
        index = TemplateIndex(problem.X)
        for query in (problem.Y, problem.X[:, : problem.Y.shape[1]], -problem.Y):
            indexed = solve(index, query, *problem.parameters)
            plain = solve(problem.X, query, *problem.parameters)
            posed = type(problem)(problem.X, query, *problem.parameters)
            check(indexed, posed, 1e-4)
            check_bounds({"indexed": indexed, "plain": plain}, min(indexed.objective, plain.objective))
