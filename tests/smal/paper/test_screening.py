"""Sequences are ruled out only where they have no weight in the solution of the full problem."""

import numpy as np
import pytest

from smal import Solution, solve
from tests.smal.paper.matching import Problem, check, check_bounds
from tests.smal.worlds import matching_problem, unit


def shares(weights: np.ndarray, length: int) -> np.ndarray:
    """Of every sequence, its part of the absolute weights."""
    sums = np.add.reduceat(np.abs(weights).sum(axis=1), np.arange(0, len(weights), length))
    return sums / max(sums.sum(), 1e-300)


def screened(problem: Problem, tolerance: float) -> dict[str, Solution]:
    """Solve where products are rounded and most sequences are never looked at exactly."""
    return {
        "plain": solve(problem.X, problem.Y, *problem.parameters, tolerance=tolerance),
        "float64": solve(
            problem.X.astype(np.float64), problem.Y, *problem.parameters, tolerance=tolerance
        ),
    }


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("kind", ["unit", "outliers", "near duplicates"])
def test_large_problems(seed: int, kind: str) -> None:
    """Of 400 sequences 1 to 10 have weight; or every template has a large entry."""
    rng = np.random.default_rng(seed)
    X, Y = matching_problem(seed, blocks=400, length=5, size=120, noise=0.5, mixed=1 + seed)
    if kind == "outliers":
        X = np.concatenate([X, np.where(rng.random(2000) < 0.5, 3.0, -3.0)[None]])
        Y = np.pad(Y, ((0, 1), (0, 0)))
    elif kind == "near duplicates":
        copies = unit(X[:, :25].T + 0.02 * unit(rng.standard_normal((25, 120))))
        X[:, 1000:1025] = copies.T
    problem = Problem(np.asfortranarray(X, dtype=np.float32), np.asfortranarray(Y), 5, 0.3, 0.3)
    solutions = screened(problem, 1e-6)
    for name, solution in solutions.items():
        check(solution, problem, 1e-6, name)
    check_bounds(solutions, min(solution.objective for solution in solutions.values()))
    heavy = np.flatnonzero(shares(solutions["plain"].weights, 5) > 1e-2)
    assert heavy.size
    for name, solution in solutions.items():
        assert set(heavy) <= set(solution.active_blocks.tolist()), name
        if kind != "near duplicates":  # unique weights
            np.testing.assert_allclose(
                solution.weights, solutions["plain"].weights, atol=5e-3, err_msg=name
            )


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_sequence_is_kept_when_its_weight_is_small(tolerance: float) -> None:
    """The query is one template and a little of another one far away, so little that rounding could hide it."""
    rng = np.random.default_rng(0)
    X = np.asfortranarray(unit(rng.standard_normal((3000, 400))).T, dtype=np.float32)
    for place in (2900, 17):
        Y = (X[:, 1500:1505] + 0.4 * X[:, place : place + 5]).copy(order="F")
        problem = Problem(X, Y, 5, 0.1, 0.1)
        for name, solution in screened(problem, tolerance).items():
            check(solution, problem, tolerance, name)
            assert {300, place // 5} <= set(solution.active_blocks.tolist()), name
