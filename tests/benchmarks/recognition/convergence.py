"""Objective and relative gap against iterations, ours beside Algorithm 2's, as figures and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smal.algorithm2 import algorithm2
from smal.state_matching import solve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from tests.benchmarks.recognition.datasets import Problem
    from tests.benchmarks.results import Record

_TOLERANCES = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
_MAX_ITERATIONS = 60
_OURS, _THEIRS, _PALE = "#0b5fa5", "#d1495b", "#9aa5b1"


def convergence(problem: Problem) -> dict[str, Any]:
    """Solve to ever smaller tolerances, and run Algorithm 2 as long as it improves.

    Gaps are relative to the best lower bound of the optimum that any of our certificates gives.
    """
    query, length, penalty = problem.queries[0], problem.length, problem.penalty
    ours: list[Record] = []
    bound = 0.0
    for tolerance in _TOLERANCES:
        found = solve(problem.templates, query, length, penalty, penalty, tolerance)
        ours.append({"tolerance": tolerance, "iterations": found.iterations, "objective": found.objective,
                     "duality_gap": found.duality_gap, "converged": found.converged})  # fmt: skip
        bound = max(bound, found.objective * (1.0 - found.duality_gap))
    theirs = algorithm2(
        problem.templates, query, length, penalty, penalty, tolerance=1e-8, max_iterations=_MAX_ITERATIONS
    )
    return {"n": problem.n, "l": length, "lower_bound": bound, "ours": ours, "algorithm2": list(theirs.objectives)}


def draw(curves: dict[str, Any], picture: Path) -> None:
    """Draw both, objective on the left and gap on the right."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second to import

    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    iterations = np.array([one["iterations"] for one in curves["ours"]])
    objectives = np.array([one["objective"] for one in curves["ours"]])
    theirs = np.array(curves["algorithm2"])
    after = np.arange(1, theirs.size + 1)
    left.plot(after, theirs, ".-", color=_THEIRS, label="Algorithm 2 as published")
    left.plot(iterations, objectives, "o-", color=_OURS, label="ours, one point a tolerance")
    left.axhline(curves["lower_bound"], color=_PALE, linestyle="--", linewidth=1.0, label="certified lower bound")
    left.set_ylabel("objective (Eq. 7)")
    right.semilogy(after, _gap(theirs, curves["lower_bound"]), ".-", color=_THEIRS, label="Algorithm 2 as published")
    right.semilogy(iterations, [one["duality_gap"] for one in curves["ours"]], "o-", color=_OURS,
                   label="ours, its own certificate")  # fmt: skip
    _mark_paper(right)
    right.set_ylabel("relative gap to the lower bound")
    for axes in (left, right):
        axes.set_xlabel("iterations")
        axes.set_xlim(left=0.0)
        axes.grid(color="#e6e9ec", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=9)
    figure.suptitle(f"Convergence on {curves['n']:,} template frames, sequences of {curves['l']}", fontsize=12)
    figure.savefig(picture, dpi=130)


def _gap(objectives: Any, bound: float) -> Any:
    return np.maximum((objectives - bound) / objectives, 1e-9)


def _mark_paper(axes: Axes) -> None:
    """Show what the paper reports: 9 and 12 iterations, and 1e-4 within 20."""
    axes.axvspan(9.0, 12.0, color=_PALE, alpha=0.18, linewidth=0.0, label="paper: 9 and 12 iterations")
    axes.plot([0.0, 20.0, 20.0], [1e-4, 1e-4, 0.0], color=_PALE, linestyle=":", linewidth=1.5,
              label="paper: below 1e-4 within 20")  # fmt: skip
