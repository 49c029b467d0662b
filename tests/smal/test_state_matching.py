"""Eq. 7 is solved: by certificate, against CVXPY and Algorithm 2, and in every degenerate case."""

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.gram import CachedTemplates, DenseTemplates
from smal.objective import objective
from smal.reference import algorithm2
from smal.state_matching import Solution, solve, solve_from_correlations
from tests.smal.worlds import matching_problem

problems = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**20),
        "blocks": st.integers(1, 10),
        "length": st.sampled_from([1, 2, 3, 5, 8]),
        "size": st.sampled_from([15, 60, 200]),
        "noise": st.sampled_from([0.0, 0.1, 0.5, 1.0]),
        "smooth": st.sampled_from([0.05, 0.3, 1.0]),
        "mixed": st.integers(1, 5),
    }
)
scales = st.sampled_from([0.02, 0.1, 0.2, 0.4])


def lower_bound(templates: np.ndarray, query: np.ndarray, length: int, lambda1: float, lambda2: float) -> float:
    """Optimum of Eq. 7 by CVXPY and Clarabel."""
    W = cp.Variable((templates.shape[1], query.shape[1]))
    blocks = [W[j : j + length] for j in range(0, templates.shape[1], length)]
    s1 = sum(cp.sum(cp.norm(block, 2, axis=0)) for block in blocks)
    residual = cp.sum(cp.norm(templates.astype(float) @ W - query.astype(float), 2, axis=0))
    problem = cp.Problem(cp.Minimize(residual + lambda1 * cp.sum(cp.norm(W, 2, axis=1)) + lambda2 * s1))
    return float(problem.solve(solver=cp.CLARABEL))


def check(solution: Solution, X: np.ndarray, Y: np.ndarray, length: int, lambda1: float, lambda2: float) -> None:
    value = objective(X, Y, solution.weights, length, lambda1, lambda2)
    assert solution.converged
    assert solution.duality_gap <= 1e-4
    assert solution.duality_gap >= -1e-6
    assert solution.objective == pytest.approx(value, rel=1e-6, abs=1e-30)
    residuals = np.linalg.norm(Y - X.astype(float) @ solution.weights, axis=0)
    np.testing.assert_allclose(solution.residual_norms, residuals, atol=1e-6 * np.linalg.norm(Y, axis=0).max())


@settings(max_examples=120, deadline=None)
@given(parameters=problems, a1=scales, a2=scales)
def test_certificate_on_random_problems(parameters: dict, a1: float, a2: float) -> None:
    X, Y = matching_problem(**parameters)
    length = parameters["length"]
    lambdas = a1 * np.sqrt(length), a2 * np.sqrt(length)
    check(solve(X, Y, length, *lambdas), X, Y, length, *lambdas)
    X = X[:, : X.shape[1] - (length > 1)]  # the last sequence may be shorter
    products = X.T @ Y, X.T @ X, np.linalg.norm(Y, axis=0)
    known = solve_from_correlations(*products, length, *lambdas)
    assert known.converged
    exact = solve(X, Y, length, *lambdas)
    assert known.objective == pytest.approx(exact.objective, abs=1.2e-3 * float(np.linalg.norm(Y, axis=0).sum()))


@pytest.mark.parametrize("seed", range(12))
def test_agrees_with_cvxpy(seed: int) -> None:
    length = [1, 2, 5, 8][seed % 4]
    X, Y = matching_problem(seed, blocks=6, length=length, noise=[0.1, 0.5, 1.0][seed % 3], mixed=2)
    lambdas = 0.1 * np.sqrt(length), 0.15 * np.sqrt(length)
    best = lower_bound(X, Y, length, *lambdas)
    solution = solve(X, Y, length, *lambdas, tolerance=1e-6)
    assert solution.objective == pytest.approx(best, rel=1e-5)
    assert solution.objective * (1 - solution.duality_gap) <= best * (1 + 1e-7)


@pytest.mark.parametrize("length", [1, 3, 5])
def test_agrees_with_algorithm_2(length: int) -> None:
    X, Y = matching_problem(3, blocks=8, length=length, noise=0.5)
    lambdas = 0.1 * np.sqrt(length), 0.1 * np.sqrt(length)
    published = algorithm2(X, Y, length, *lambdas, tolerance=1e-9)
    assert published.converged
    assert np.diff(published.objectives).max() <= 1e-7
    solution = solve(X, Y, length, *lambdas, tolerance=1e-6)
    assert solution.objective == pytest.approx(published.objectives[-1], rel=1e-4)
    assert solution.objective <= published.objectives[-1] * (1 + 1e-6)
    np.testing.assert_allclose(solution.weights, published.weights, atol=5e-3)


@settings(max_examples=20, deadline=None)
@given(x_power=st.integers(-6, 6), y_power=st.integers(-6, 6))
def test_scales(x_power: int, y_power: int) -> None:
    X, Y = matching_problem(1, blocks=4, length=3)
    plain = solve(X, Y, 3, 0.2, 0.2)
    Xs, Ys = (X * 10.0**x_power).astype(np.float32), (Y * 10.0**y_power).astype(np.float32)
    scaled = solve(Xs, Ys, 3, 0.2 * 10.0**x_power, 0.2 * 10.0**x_power)
    assert scaled.converged
    assert scaled.objective == pytest.approx(plain.objective * 10.0**y_power, rel=1e-4)
    np.testing.assert_allclose(scaled.weights * 10.0 ** (x_power - y_power), plain.weights, atol=2e-2)


@pytest.mark.parametrize("length", [1, 5, 10])
def test_exact_duplicate(length: int) -> None:
    X, _ = matching_problem(5, blocks=6, length=length, size=200)
    Y = X[:, length : 2 * length].copy()
    # lambda1 + lambda2 < 1, the slope of a residual, so that most residuals are zero: the norms have no gradient there.
    solution = solve(X, Y, length, 0.1, 0.1)
    check(solution, X, Y, length, 0.1, 0.1)
    assert solution.residual_norms.max() < 0.05
    assert solution.active_blocks.tolist() == [1]


def test_no_weight_at_high_lambda_is_exact() -> None:
    X, Y = matching_problem(0, blocks=5, length=5)
    solution = solve(X, Y, 5, 10.0, 10.0)
    assert not solution.weights.any()
    assert solution.duality_gap == 0.0
    assert solution.objective == pytest.approx(np.linalg.norm(Y, axis=0).sum())


@pytest.mark.parametrize("lambdas", [(0.3, 0.0), (0.0, 0.3)])
def test_one_penalty_alone(lambdas: tuple[float, float]) -> None:
    X, Y = matching_problem(8, blocks=5, length=4)
    solution = solve(X, Y, 4, *lambdas)
    check(solution, X, Y, 4, *lambdas)
    assert solution.objective == pytest.approx(lower_bound(X, Y, 4, *lambdas), rel=1e-4)


def test_zero_query_frames_get_no_weight() -> None:
    X, Y = matching_problem(2, blocks=4, length=3)
    assert solve(X, np.zeros_like(Y), 3, 0.2, 0.2).objective == 0.0
    Y[:, 1] = 0.0
    solution = solve(X, Y, 3, 0.2, 0.2)
    check(solution, X, Y, 3, 0.2, 0.2)
    assert not solution.weights[:, 1].any()
    assert solution.weights.any()


def test_zero_and_repeated_and_collinear_templates() -> None:
    X, Y = matching_problem(4, blocks=4, length=3)
    X[:, 4] = 0.0
    X[:, 9:12] = X[:, 0:3]
    X[:, 6] = 0.5 * X[:, 7]
    solution = solve(X, Y, 3, 0.2, 0.2)
    check(solution, X, Y, 3, 0.2, 0.2)
    assert not solution.weights[4].any()


def test_one_template() -> None:
    X, _ = matching_problem(6, blocks=1, length=1)
    solution = solve(X, X, 1, 0.1, 0.1)
    assert solution.converged
    assert solution.weights == pytest.approx(np.ones((1, 1)), abs=1e-3)
    assert not solve(np.zeros_like(X), X, 1, 0.1, 0.1).weights.any()


def test_every_source_of_products_gives_the_same_answer() -> None:
    X, Y = matching_problem(9, blocks=12, length=5, size=200, mixed=3)
    products = X.T @ Y
    norms = np.linalg.norm(Y, axis=0)
    gram = X.T @ X
    plain = solve_from_correlations(products, gram, norms, 5, 0.2, 0.2)
    tiny = CachedTemplates(X, 5, max_bytes=1)  # keeps one sequence at a time
    for source in (DenseTemplates(X), CachedTemplates(X, 5), tiny):
        other = solve_from_correlations(products, source, norms, 5, 0.2, 0.2, warm_start=plain)
        assert other.converged
        assert other.objective == pytest.approx(plain.objective, rel=1e-4)
    given_gram = solve(X, Y, 5, 0.2, 0.2, gram=gram.astype(np.float64))
    assert given_gram.objective == pytest.approx(solve(X, Y, 5, 0.2, 0.2).objective, rel=1e-4)


def test_inactive_sequences_have_no_weight_in_the_full_solution() -> None:
    X, Y = matching_problem(11, blocks=10, length=5, size=100, mixed=3)
    solution = solve(X, Y, 5, 0.2, 0.2, tolerance=1e-6)
    everything = algorithm2(X, Y, 5, 0.2, 0.2, tolerance=1e-8)
    used = np.flatnonzero(np.abs(everything.weights).reshape(10, -1).sum(axis=1) > 1e-2)
    assert set(used) <= set(solution.active_blocks.tolist())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["templates", "query"])
def test_not_finite_is_refused(bad: float, where: str) -> None:
    X, Y = matching_problem(0, blocks=3, length=2)
    (X if where == "templates" else Y)[0, 0] = bad
    with pytest.raises(ValueError, match="NaN or infinity"), np.errstate(invalid="ignore"):
        solve(X, Y, 2, 0.1, 0.1)
    with pytest.raises(ValueError, match="NaN or infinity"), np.errstate(invalid="ignore"):
        solve_from_correlations(X.T @ Y, X.T @ X, np.linalg.norm(Y, axis=0), 2, 0.1, 0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sequence_length": 0}, "sequence_length"),
        ({"lambda1": -1.0}, "lambda1"),
        ({"lambda1": 0.0, "lambda2": 0.0}, "not both 0"),
        ({"lambda2": np.nan}, "lambda2"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"query": np.ones((3, 2), np.float32)}, "do not fit"),
        ({"templates": np.ones((60, 0), np.float32)}, "at least one template"),
        ({"templates": np.ones((60, 2), np.int64)}, "floating point"),
        ({"gram": np.ones((2, 2))}, "gram"),
    ],
)
def test_bad_input_is_refused(change: dict, words: str) -> None:
    X, Y = matching_problem(0, blocks=3, length=2)
    arguments = {"templates": X, "query": Y, "sequence_length": 2, "lambda1": 0.1, "lambda2": 0.1} | change
    with pytest.raises(ValueError, match=words):
        solve(**arguments)
    with pytest.raises(ValueError, match="do not fit"):
        solve_from_correlations(X.T @ Y, X.T @ X, np.ones(3), 2, 0.1, 0.1)
