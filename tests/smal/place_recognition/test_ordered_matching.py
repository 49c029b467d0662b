"""Ordered matching against an interior-point solver, and its duality gap against a calculation by hand."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from smal.place_recognition.ordered_matching import solve_ordered
from tests.smal.place_recognition.ordered_problems import (
    FLOOR,
    SPEED_TABLES,
    STRUCTURES,
    problem_of,
    unit,
)

#: Where no residual vanishes, float32 decides nothing.
EVERYDAY = sorted(set(STRUCTURES) - {"identical", "blind", "opposed"})
examples = settings(
    max_examples=250, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate)
)  # fmt: skip


@pytest.mark.parametrize("speeds", range(len(SPEED_TABLES)))
@pytest.mark.parametrize("structure", EVERYDAY)
def test_the_optimum_is_that_of_an_interior_point_solver(structure: str, speeds: int) -> None:
    for seed, (n, length, penalty) in enumerate([(15, 1, 0.5), (22, 3, 0.3), (40, 6, 0.7)]):
        problem = problem_of(structure, seed, n, length, speeds, penalty)
        solution = problem.solve(tolerance=1e-6)
        optimum = problem.optimum()
        assert problem.primal(problem.weights(solution)) == pytest.approx(optimum, rel=1e-5)
        assert solution.objective == pytest.approx(optimum, rel=1e-5)
        assert solution.weights.size


@pytest.mark.parametrize("structure", ["identical", "blind"])
def test_the_optimum_where_residuals_vanish(structure: str) -> None:
    """There float32 products leave the residual norms uncertain by `FLOOR`."""
    for seed in range(6):
        problem = problem_of(structure, seed, 20, 1 + seed, seed % 3, 0.5)
        solution = problem.solve(tolerance=1e-6)
        assert solution.duality_gap <= 1e-3
        assert problem.primal(problem.weights(solution)) == pytest.approx(problem.optimum(), rel=1e-3, abs=1e-6)


@examples
@given(
    structure=st.sampled_from(sorted(STRUCTURES)),
    seed=st.integers(0, 2**31),
    n=st.integers(1, 40),
    length=st.integers(1, 6),
    speeds=st.integers(0, len(SPEED_TABLES) - 1),
    penalty=st.sampled_from([1e-3, 0.05, 0.3, 0.5, 0.8, 0.95]),
)
def test_the_duality_gap_is_true(
    structure: str, seed: int, n: int, length: int, speeds: int, penalty: float
) -> None:  # fmt: skip
    problem = problem_of(structure, seed, n, length, speeds, penalty)
    solution = problem.solve(tolerance=1e-6)
    weights = problem.weights(solution)
    assert (solution.weights > 0.0).all()
    if problem.penalty < 1e-6:
        assert not solution.weights.size  # no sequence is alike
        return
    assert solution.penalty == pytest.approx(problem.penalty, rel=1e-5)
    residuals = np.linalg.norm(problem.residuals(weights), axis=1)
    longest = float(np.linalg.norm(problem.references, axis=1).max())
    # What float32 products add, by the docstring of `OrderedSolution`.
    rounding = 6e-7 * longest * (1 + longest * weights.sum()) / (max(residuals.min(), FLOOR) * problem.penalty)
    assert problem.gap(weights) <= solution.duality_gap + 1e-5 + rounding
    if penalty >= 0.3 and residuals.min() > 0.05:
        assert rounding < 1e-3 * longest * length * longest
        assert solution.duality_gap < 1e-4
        assert solution.objective == pytest.approx(problem.primal(weights), rel=1e-5)


def test_the_duality_gap_of_an_answer_that_is_not_optimal_says_so() -> None:
    problem = problem_of("duplicates", 0, 40, 6, 2, 0.05)
    rough, fine = problem.solve(tolerance=0.3), problem.solve(tolerance=1e-6)
    assert 1e-3 < problem.gap(problem.weights(rough)) <= rough.duality_gap + 1e-5
    assert rough.duality_gap <= 0.3
    assert fine.objective < rough.objective


@pytest.mark.parametrize("penalty", [0.5, 0.9])
def test_a_copy_of_long_features_is_certified(penalty: float) -> None:
    """Products of thousands of numbers are off by more than those of a few: the residual's direction is noise."""
    rng = np.random.default_rng(6)
    features = unit(np.cumsum(rng.normal(size=(40, 6000)), axis=0) + rng.normal(size=(40, 6000))).astype(np.float32)
    gram = features @ features.T
    norms = np.linalg.norm(features, axis=1).astype(np.float64)
    for end in range(5, 40, 7):
        window = slice(end - 4, end + 1)
        solution = solve_ordered(
            gram[window], norms[window], gram, SPEED_TABLES[2][0], np.array(SPEED_TABLES[2][1]), penalty, 1e-3
        )
        assert solution.duality_gap <= 1e-3
