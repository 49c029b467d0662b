"""Ordered matching against an interior-point solver, and its certificate against a calculation by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from smal.place_recognition.ordered_matching import solve_ordered
from smal.place_recognition.template_sequences import TemplateSequences
from tests.smal.place_recognition.ordered_problems import (
    FLOOR,
    SPEED_TABLES,
    STRUCTURES,
    OrderedProblem,
    problem_of,
    unit,
    walk,
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
    penalty=st.sampled_from([1e-3, 0.05, 0.3, 0.5, 0.8, 0.95, 0.999]),
)
def test_the_certificate_is_true(
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


def test_the_certificate_of_an_answer_that_is_not_optimal_says_so() -> None:
    problem = problem_of("duplicates", 0, 40, 6, 2, 0.05)
    rough, fine = problem.solve(tolerance=0.3), problem.solve(tolerance=1e-6)
    assert 1e-3 < problem.gap(problem.weights(rough)) <= rough.duality_gap + 1e-5
    assert rough.duality_gap <= 0.3
    assert fine.objective < rough.objective


@pytest.mark.parametrize("structure", ["opposed", "blind"])
def test_without_similarity_there_is_no_sequence(structure: str) -> None:
    problem = problem_of(structure, 3, 20, 4, 2, 0.5)
    if structure == "blind":
        problem = replace(problem, queries=np.zeros_like(problem.queries))
    solution = problem.solve()
    assert solution.sequences.size == solution.weights.size == 0
    assert (solution.penalty, solution.duality_gap) == (0.0, 0.0)
    assert solution.objective == pytest.approx(np.linalg.norm(problem.queries, axis=1).mean())


def test_fewer_references_than_frames_have_no_sequence() -> None:
    problem = problem_of("walk", 0, 4, 6, 0, 0.5)
    assert not problem.sequences
    assert not problem.solve().sequences.size


def test_a_copy_is_explained_by_itself() -> None:
    references = walk(np.random.default_rng(5), 60, 32)
    problem = OrderedProblem(references, references[20:30], *SPEED_TABLES[2], 0.5)
    solution = problem.solve(1e-3)
    best = solution.sequences[solution.weights.argmax()]
    assert problem.sequences[int(best)] == list(range(20, 30))
    assert solution.weights.max() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("penalty", [0.5, 0.9])
def test_a_copy_of_long_features_is_certified(penalty: float) -> None:
    """Products of thousands of numbers are off by more than those of a few: the residual's direction is noise."""
    rng = np.random.default_rng(6)
    features = unit(np.cumsum(rng.normal(size=(40, 6000)), axis=0) + rng.normal(size=(40, 6000))).astype(np.float32)
    gram = features @ features.T
    norms = np.linalg.norm(features, axis=1).astype(np.float64)
    sequences = TemplateSequences(5, SPEED_TABLES[2][0])
    for end in range(5, 40, 7):
        window = slice(end - 4, end + 1)
        solution = solve_ordered(
            gram[window], norms[window], gram, sequences, np.array(SPEED_TABLES[2][1]), penalty, tolerance=1e-3
        )
        assert solution.duality_gap <= 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_the_speeds_makes_no_difference(seed: int) -> None:
    problem = problem_of("walk", seed, 35, 5, 2, 0.4)
    order = np.random.default_rng(seed).permutation(len(problem.speeds))
    permuted = replace(
        problem,
        speeds=tuple(problem.speeds[place] for place in order),
        surcharge=tuple(problem.surcharge[place] for place in order),
    )
    one, other = problem.solve(), permuted.solve()
    assert one.objective == pytest.approx(other.objective, rel=1e-5)
    assert one.penalty == pytest.approx(other.penalty, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_references_that_resemble_nothing_make_no_difference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = problem_of("walk", seed, 30, 5, 2, 0.4)
    # Orthogonal to all that was there, in dimensions of their own.
    aliens = np.concatenate([np.zeros((25, 16)), unit(rng.normal(size=(25, 25)))], axis=1)
    more = replace(
        problem,
        references=np.concatenate([np.pad(problem.references, ((0, 0), (0, 25))), aliens]),
        queries=np.pad(problem.queries, ((0, 0), (0, 25))),
    )
    one, other = problem.solve(), more.solve()
    assert one.objective == pytest.approx(other.objective, rel=1e-5)
    found = {tuple(more.sequences[number]): c for number, c in zip(other.sequences, other.weights, strict=True)}
    for number, c in zip(one.sequences, one.weights, strict=True):
        if c > 1e-2 * one.weights.sum():
            assert found[tuple(problem.sequences[int(number)])] == pytest.approx(c, abs=1e-3)


def occluded(problem: OrderedProblem, frames: int, rng: np.random.Generator) -> OrderedProblem:
    queries = problem.queries.copy()
    queries[rng.permutation(len(queries))[:frames]] = unit(rng.normal(size=(frames, queries.shape[1])))
    return replace(problem, queries=queries)


@pytest.mark.parametrize("seed", range(20))
def test_with_three_of_ten_frames_occluded_the_place_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    references = walk(rng, 60, 64)
    clear = unit(references[30:40] + 0.05 * rng.normal(size=(10, 64)))
    problem = OrderedProblem(references, clear, *SPEED_TABLES[2], 0.5)
    solution = occluded(problem, 3, rng).solve()
    best = int(solution.sequences[solution.weights.argmax()])
    assert problem.sequences[best] == list(range(30, 40))


def test_occluded_frames_cost_less_weight_than_with_squares() -> None:
    """Squared residuals, at the same lambda (which is the same share of the smallest for which c = 0 in both)."""
    kept, squared = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        references = walk(rng, 40, 64)
        clear = OrderedProblem(references, unit(references[20:30] + 0.05 * rng.normal(size=(10, 64))))
        spoilt = occluded(clear, 3, rng)
        spoilt = replace(spoilt, relative_penalty=0.5 * clear.penalty / spoilt.penalty)
        assert spoilt.penalty == pytest.approx(clear.penalty)
        weights = [problem.solve().weights.sum() for problem in (clear, spoilt)]
        # min_c 1/2l sum_i ||y_i - c x_i||^2 + lambda c for the sequence at the place.
        products = [float(np.sum(problem.queries * references[20:30])) / 10 for problem in (clear, spoilt)]
        kept.append(weights[1] / weights[0])
        squared.append((products[1] - clear.penalty) / (products[0] - clear.penalty))
    assert np.median(kept) > np.median(squared) + 0.05
