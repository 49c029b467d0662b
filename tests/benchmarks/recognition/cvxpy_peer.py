"""Our solver against CVXPY with Clarabel, a general interior point solver, on the same problem."""

from __future__ import annotations

import importlib
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from smal.paper.objective import objective
from smal.paper.state_matching import solve
from tests.benchmarks.recognition.timing import seconds_of
from tests.benchmarks.results import LeftOutError

if TYPE_CHECKING:
    from tests.benchmarks.recognition.datasets import Problem
    from tests.benchmarks.results import Record

_REPETITIONS = 5


def against_cvxpy(problem: Problem, tolerances: tuple[float, ...]) -> list[Record]:
    """Solve with CVXPY once, with ours to each tolerance.

    Raises
    ------
    LeftOutError
        CVXPY or Clarabel is not installed, or finds no solution.
    """
    query = problem.queries[0]
    total_s, (weights, solver_s, form) = seconds_of(lambda: _solve(problem))
    theirs = objective(problem.templates, query, weights, problem.length, problem.penalty, problem.penalty)
    records: list[Record] = []
    for tolerance in tolerances:
        ours = partial(solve, problem.templates, query, problem.length, problem.penalty, problem.penalty, tolerance)
        found = ours().objective
        seconds = float(np.median([seconds_of(ours)[0] for _ in range(_REPETITIONS)]))
        records.append({
            "n": problem.n, "l": problem.length, "tolerance": tolerance, "form": form, "our_seconds": seconds,
            "cvxpy_seconds": total_s, "clarabel_seconds": solver_s, "times_faster": total_s / seconds,
            "times_faster_than_clarabel_alone": solver_s / seconds, "our_objective": found, "cvxpy_objective": theirs,
            "relative_difference": (found - theirs) / theirs,
        })  # fmt: skip
    return records


def _solve(problem: Problem) -> tuple[NDArray[np.float64], float, str]:
    """Reduce, formulate and solve; return W, the time of Clarabel alone, and which form it was given."""
    try:
        cp: Any = importlib.import_module("cvxpy")  # takes seconds, and only developers have it
    except ImportError:
        raise LeftOutError("CVXPY is not installed (deploy/requirements/dev.txt)") from None
    X, Y, form = _smaller_form(problem)
    W = cp.Variable((X.shape[1], Y.shape[1]))
    blocks = [cp.norm(W[start : start + problem.length], 2, axis=0) for start in range(0, problem.n, problem.length)]
    penalties = cp.sum(cp.norm(W, 2, axis=1)) + cp.sum(cp.hstack(blocks))
    task = cp.Problem(cp.Minimize(cp.sum(cp.norm(X @ W - Y, 2, axis=0)) + problem.penalty * penalties))
    try:
        task.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as error:
        raise LeftOutError(f"CVXPY: {error}") from None
    if task.status != cp.OPTIMAL:
        raise LeftOutError(f"CVXPY ended with the status {task.status}")
    return W.value, float(task.solver_stats.solve_time), form


def _smaller_form(problem: Problem) -> tuple[NDArray[Any], NDArray[Any], str]:
    """Rotate [X Y] to n + l rows by a QR factorisation if it has more; no residual norm changes."""
    both = np.hstack([problem.templates, problem.queries[0]]).astype(np.float64)
    form = f"raw, {both.shape[0]} rows"
    if both.shape[0] > both.shape[1]:
        both = np.asarray(np.linalg.qr(both, mode="r"))
        form = f"QR of [X Y], {both.shape[0]} rows of {problem.templates.shape[0]}"
    return both[:, : problem.n], both[:, problem.n :], form
