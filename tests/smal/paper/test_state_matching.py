"""Eq. 7 is solved: by duality gap, against CVXPY and Algorithm 2, in degenerate cases."""

import numpy as np
import pytest

from smal import solve
from tests.benchmarks.recognition.algorithm2 import algorithm2
from tests.smal.paper.matching import (
    STRUCTURES,
    Problem,
    answers,
    check,
    check_bounds,
    optimum,
    polar,
    structured,
)
from tests.smal.worlds import matching_problem

# Templates that span the whole space leave no residuals: `solve` promises no more than about 1e-5 there, and is slow.
CASES = [
    (one, tolerance)
    for one in STRUCTURES
    for tolerance in (1e-3, 1e-6)
    if (one, tolerance) != ("rank deficient", 1e-6)
]


@pytest.mark.parametrize(("structure", "tolerance"), CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_every_entry_is_certified(structure: str, tolerance: float, seed: int) -> None:
    problem = structured(structure, seed)
    solutions = dict(answers(problem, tolerance))
    for name, solution in solutions.items():
        check(solution, problem, tolerance, name)
    sharp = solve(
        problem.X,
        problem.Y,
        *problem.parameters,
        tolerance=1e-5 if structure == "rank deficient" else 1e-6,
    )
    best = min(problem.value(solution.weights) for solution in (*solutions.values(), sharp))
    check_bounds(
        solutions | {"sharp": sharp}, best + 4e-8 * float(np.linalg.norm(problem.Y, axis=0).sum())
    )


@pytest.mark.parametrize("structure", STRUCTURES)
def test_agrees_with_cvxpy(structure: str) -> None:
    problems = (structured(structure, seed) for seed in range(60))
    problem = next(one for one in problems if one.X.shape[1] <= 60)
    best = optimum(problem)
    norms = float(np.linalg.norm(problem.Y, axis=0).sum())
    for name, solution in answers(problem, 1e-6):
        assert solution.objective == pytest.approx(best, rel=1e-5, abs=1e-6 * norms), name
        check_bounds({name: solution}, best * (1 + 1e-6) + 1e-7 * norms)


@pytest.mark.parametrize("length", [1, 3, 5])
def test_agrees_with_algorithm_2(length: int) -> None:
    X, Y = matching_problem(3, blocks=8, length=length, noise=0.5)
    lambdas = 0.1 * np.sqrt(length), 0.1 * np.sqrt(length)
    published = algorithm2(X, Y, length, *lambdas, tolerance=1e-9)
    assert published.converged
    solution = solve(X, Y, length, *lambdas, tolerance=1e-6)
    assert solution.objective == pytest.approx(published.objectives[-1], rel=1e-4)
    np.testing.assert_allclose(solution.weights, published.weights, atol=5e-3)


@pytest.mark.parametrize("lambdas", [(1.0, 0.0), (0.0, 1.0), (0.5, 0.8)])
def test_weights_vanish_when_lambda_reaches_its_edge(lambdas: tuple[float, float]) -> None:
    """W = 0 is optimal where X_j^T Y / ||y_i|| of every sequence is in the dual set, and nowhere else."""
    X, Y = matching_problem(3, blocks=4, length=3)
    norms = np.linalg.norm(Y, axis=0)
    edge = max(polar(block, *lambdas) for block in np.split((X.T @ Y / norms).astype(float), 4))
    for share in (0.98, 1 - 1e-6, 1.0, 1 + 1e-6, 1.001):
        problem = Problem(X, Y, 3, share * edge * lambdas[0], share * edge * lambdas[1])
        for name, solution in answers(problem, 1e-6):
            check(solution, problem, 1e-6, name)
            if share < 0.99:
                assert solution.objective < norms.sum() * (1 - 1e-5)
            elif share > 1.0:
                assert solution.objective == pytest.approx(norms.sum(), rel=1e-6)


@pytest.mark.parametrize("lambdas", [(0.3, 0.0), (0.0, 0.3)])
def test_objective_is_minimal_when_one_penalty_is_zero(lambdas: tuple[float, float]) -> None:
    X, Y = matching_problem(8, blocks=5, length=4)
    problem = Problem(X, Y, 4, *lambdas)
    best = optimum(problem)
    for name, solution in answers(problem, 1e-4):
        check(solution, problem, 1e-4, name)
        assert solution.objective == pytest.approx(best, rel=1e-4)


def test_zero_query_frames_get_no_weight() -> None:
    X, Y = matching_problem(2, blocks=4, length=3)
    for _, solution in answers(Problem(X, np.zeros_like(Y), 3, 0.2, 0.2), 1e-4):
        assert (solution.objective, solution.duality_gap, solution.converged) == (0.0, 0.0, True)
        assert not solution.weights.any()
    Y[:, 1] = 0.0
    problem = Problem(X, Y, 3, 0.2, 0.2)
    for name, solution in answers(problem, 1e-4):
        check(solution, problem, 1e-4, name)
        assert not solution.weights[:, 1].any()
        assert solution.weights.any()


def test_zero_and_repeated_and_collinear_templates() -> None:
    X, Y = matching_problem(4, blocks=4, length=3)
    X[:, 4] = 0.0
    X[:, 9:12] = X[:, 0:3]
    X[:, 6] = 0.5 * X[:, 7]
    problem = Problem(X, Y, 3, 0.2, 0.2)
    for name, solution in answers(problem, 1e-4):
        check(solution, problem, 1e-4, name)
        assert not solution.weights[4].any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("lambda1", [0.1, 20.0])
@pytest.mark.parametrize(
    ("name", "column"), [*(("X", k) for k in (0, 199, 399)), ("Y", 0), ("Y", 3)]
)
def test_problem_is_refused_when_an_entry_is_not_finite(
    name: str, column: int, lambda1: float, bad: float
) -> None:
    given = dict(zip("XY", matching_problem(0, blocks=100, length=4), strict=True))
    given[name][-1, column] = bad
    named = "query contains NaN or infinity" if name == "Y" else "NaN or infinity"
    for kind in (np.float32, np.float64):
        for made in (np.asfortranarray, np.ascontiguousarray):
            arrays = given | {name: made(given[name], dtype=kind)}
            with pytest.raises(ValueError, match=named), np.errstate(all="ignore"):
                solve(arrays["X"], arrays["Y"], 4, lambda1, 0.1)
