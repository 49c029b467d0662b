"""Hard problems of state matching, all ways to solve them, and the properties of any solution."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from smal import Solution, solve
from smal.paper.objective import objective
from tests.smal.worlds import corridor, matching_problem, unit

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Problem:
    """Eq. 7, with float32 templates (m, n) in Fortran order."""

    X: Array
    Y: Array
    length: int
    lambda1: float
    lambda2: float

    @property
    def parameters(self) -> tuple[int, float, float]:
        return self.length, self.lambda1, self.lambda2

    def value(self, weights: Array) -> float:
        return objective(self.X, self.Y, weights, *self.parameters)


def _problem(X: Array, Y: Array, length: int, rng: np.random.Generator) -> Problem:
    scales = rng.choice([0.05, 0.1, 0.2, 0.4], 2) * np.sqrt(length)
    templates, query = (np.asfortranarray(array, dtype=np.float32) for array in (X, Y))
    return Problem(templates, query, length, float(scales[0]), float(scales[1]))


def _mixture(rng: np.random.Generator) -> Problem:
    length = int(rng.choice([1, 2, 3, 5, 8]))
    X, Y = matching_problem(
        int(rng.integers(2**31)), int(rng.integers(2, 13)), length, int(rng.choice([60, 200])),
        float(rng.choice([0.0, 0.1, 0.5, 1.0])), float(rng.choice([0.05, 0.3, 1.0])), int(rng.integers(2, 5)),
    )  # fmt: skip
    return _problem(X, Y, length, rng)


def _near_duplicates(rng: np.random.Generator) -> Problem:
    """Several demonstrations of one route, and a query on it between two cuts."""
    length = int(rng.choice([2, 3, 5]))
    size = 100
    route = corridor(4 * length, size, int(rng.integers(2**31)))
    noise = float(rng.choice([1e-4, 0.05, 0.3]))
    drives = [unit(route + noise * unit(rng.standard_normal(route.shape))) for _ in range(5)]
    start = int(rng.integers(0, len(route) - length))
    query = unit(route[start : start + length] + 0.2 * unit(rng.standard_normal((length, size))))
    return _problem(np.concatenate(drives).T, query.T, length, rng)


def _exact_duplicates(rng: np.random.Generator) -> Problem:
    problem = _mixture(rng)
    first = problem.X[:, : problem.length]
    return replace(
        problem, X=np.asfortranarray(np.concatenate([problem.X, first, problem.X], axis=1))
    )


def _rank_deficient(rng: np.random.Generator) -> Problem:
    """Up to 50 times as many templates as entries."""
    length = int(rng.choice([1, 2, 5]))
    n = int(rng.choice([20, 150]))
    size = int(rng.choice([3, 10, 40]))
    X = unit(rng.standard_normal((n, size)))
    Y = unit(rng.standard_normal((length, size)))
    return _problem(X.T, Y.T, length, rng)


def _noise_only(rng: np.random.Generator) -> Problem:
    problem = _mixture(rng)
    noise = unit(rng.standard_normal(problem.Y.T.shape)).T
    return replace(problem, Y=np.asfortranarray(noise, dtype=np.float32))


def _shorter_last_sequence(rng: np.random.Generator) -> Problem:
    problem = _near_duplicates(rng)
    return replace(
        problem, X=problem.X[:, : problem.X.shape[1] - int(rng.integers(1, problem.length))]
    )


def _other_query_length(rng: np.random.Generator) -> Problem:
    problem = _mixture(rng)
    chosen = rng.integers(0, problem.X.shape[1], int(rng.integers(1, 13)))
    query = problem.X.T[chosen] + 0.5 * unit(rng.standard_normal((chosen.size, problem.X.shape[0])))
    return replace(problem, Y=np.asfortranarray(query.T, dtype=np.float32))


def _lengths_of_all_sizes(rng: np.random.Generator) -> Problem:
    problem = _mixture(rng)
    X = problem.X * 10.0 ** rng.uniform(-1.0, 0.0, problem.X.shape[1])
    Y = problem.Y * 10.0 ** rng.uniform(-2.0, 2.0, problem.Y.shape[1])
    return replace(
        problem, X=np.asfortranarray(X, dtype=np.float32), Y=np.asfortranarray(Y, dtype=np.float32)
    )


STRUCTURES: dict[str, Callable[[np.random.Generator], Problem]] = {
    "mixture": _mixture,
    "near duplicates": _near_duplicates,
    "exact duplicates": _exact_duplicates,
    "rank deficient": _rank_deficient,
    "noise only": _noise_only,
    "shorter last sequence": _shorter_last_sequence,
    "other query length": _other_query_length,
    "lengths of all sizes": _lengths_of_all_sizes,
}


def structured(structure: str, seed: int) -> Problem:
    return STRUCTURES[structure](np.random.default_rng(seed))


def answers(problem: Problem, tolerance: float) -> Iterator[tuple[str, Solution]]:
    """Solve one problem, given in all ways that have the same optimum."""
    X = problem.X
    Y = problem.Y
    parameters = (*problem.parameters, tolerance)
    yield "Fortran order", solve(X, Y, *parameters)
    yield "C order", solve(np.ascontiguousarray(X), Y, *parameters)
    yield "float64", solve(X.astype(np.float64), Y.astype(np.float64), *parameters)


def check(solution: Solution, problem: Problem, tolerance: float, what: str = "") -> None:
    """Check all properties of a solution."""
    lengths = np.linalg.norm(problem.Y.astype(np.float64), axis=0)
    assert solution.converged, (what, solution.duality_gap)
    assert -1e-7 <= solution.duality_gap <= tolerance, what
    # A residual below 3e-8 of a query frame is rounding, and counts as that.
    rounding = 4e-8 * float(lengths.sum())
    assert (
        abs(solution.objective - problem.value(solution.weights))
        <= 1e-7 * solution.objective + rounding
    ), what
    assert solution.objective <= lengths.sum() * (1 + tolerance), what
    residuals = np.linalg.norm(problem.Y - problem.X.astype(np.float64) @ solution.weights, axis=0)
    np.testing.assert_allclose(
        solution.residual_norms, residuals, rtol=1e-6, atol=1e-6 * lengths.max()
    )
    assert solution.weights.shape == (problem.X.shape[1], problem.Y.shape[1])
    assert np.array_equal(solution.active, np.flatnonzero(solution.weights.any(axis=1)))


def check_bounds(solutions: dict[str, Solution], best: float) -> None:
    """Check that no lower bound exceeds the best objective."""
    for name, solution in solutions.items():
        bound = solution.objective * (1.0 - solution.duality_gap)
        assert bound <= best * (1 + 1e-9), (name, bound, best)


def optimum(problem: Problem) -> float:
    """Minimum of Eq. 7 by CVXPY and Clarabel."""
    X = problem.X.astype(float)
    Y = problem.Y.astype(float)
    length = problem.length
    import cvxpy as cp  # noqa: PLC0415 - takes long to load, and all processes read this file

    W = cp.Variable((X.shape[1], Y.shape[1]))
    s1 = sum(
        cp.sum(cp.norm(W[start : start + length], 2, axis=0))
        for start in range(0, X.shape[1], length)
    )
    penalty = problem.lambda1 * cp.sum(cp.norm(W, 2, axis=1)) + problem.lambda2 * s1
    return float(
        cp.Problem(cp.Minimize(cp.sum(cp.norm(X @ W - Y, 2, axis=0)) + penalty)).solve(
            solver=cp.CLARABEL
        )
    )


def polar(G: Array, lambda1: float, lambda2: float) -> float:
    """Polar of the penalty of one sequence, exactly: the least s for which G / s is in the dual set."""
    import cvxpy as cp  # noqa: PLC0415 - takes long to load, and all processes read this file

    A = cp.Variable(G.shape)
    s = cp.Variable()
    constraints = [cp.norm(A, 2, axis=1) <= lambda1 * s, cp.norm(G - A, 2, axis=0) <= lambda2 * s]
    return float(cp.Problem(cp.Minimize(s), constraints).solve(solver=cp.CLARABEL))
