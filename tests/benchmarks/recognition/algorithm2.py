"""Our solver against Algorithm 2 as published, on the same problem and to the same objective."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from smal.paper import algorithm2
from smal.paper.state_matching import solve
from tests.benchmarks.recognition.timing import seconds_of

if TYPE_CHECKING:
    from tests.benchmarks.recognition.datasets import Problem
    from tests.benchmarks.results import Record

#: How close to our objective, relative, Algorithm 2 must come; it is then stopped.
_CLOSE = 1e-4
_MAX_ITERATIONS = 500
_REPETITIONS = 5


def whole_run(problem: Problem) -> Record:
    """Run Algorithm 2 until its objective is close to ours; where it never is, until it has converged."""
    templates, query = problem.templates, problem.queries[0]
    run = partial(algorithm2.algorithm2, templates, query, problem.length, problem.penalty, problem.penalty)
    ours_s, ours = _time_ours(problem)
    result = run(max_iterations=_MAX_ITERATIONS)
    above = np.array(result.objectives) / ours - 1.0
    close = np.flatnonzero(above <= _CLOSE)
    iterations = int(close[0]) + 1 if close.size else len(above)
    seconds, _ = seconds_of(lambda: run(tolerance=0.0, max_iterations=iterations))
    return {
        "n": problem.n,
        "l": problem.length,
        "iterations": iterations,
        "reaches_our_objective": bool(close.size),
        "relative_excess": float(above[iterations - 1]),
        "converged_relative_excess": float(above[-1]) if result.converged else None,
        "converged_after": len(above) if result.converged else None,
        "algorithm2_seconds": seconds,
        "our_seconds": ours_s,
        "times_faster": seconds / ours_s,
    }


def from_one_solve(problem: Problem, iterations: int) -> Record:
    """Time one of the l dense solves of an iteration, times l, times the iterations that a smaller problem took.

    In favour of Algorithm 2, neither X^T X nor the choice of where to start nor the objective is counted.
    """
    ours_s, _ = _time_ours(problem)
    X = np.asarray(problem.templates, dtype=np.float64)
    gram = X.T @ X
    correlations = X.T @ problem.queries[0][:, :1].astype(np.float64)
    # The time of a dense solve does not depend on the weights.
    one_column = partial(
        algorithm2._iterate, gram, correlations, np.ones(1), correlations, problem.length, problem.penalty,
        problem.penalty, 1e-8,
    )  # fmt: skip
    seconds, _ = seconds_of(one_column)
    total = seconds * problem.length * iterations
    return {
        "n": problem.n,
        "l": problem.length,
        "iterations": iterations,
        "solve_seconds": seconds,
        "algorithm2_seconds": total,
        "our_seconds": ours_s,
        "times_faster": total / ours_s,
    }


def _time_ours(problem: Problem) -> tuple[float, float]:
    """Time our solver on the first query, the median; return its objective too."""
    ours = partial(solve, problem.templates, problem.queries[0], problem.length, problem.penalty, problem.penalty)
    objective = ours().objective
    return float(np.median([seconds_of(ours)[0] for _ in range(_REPETITIONS)])), objective
