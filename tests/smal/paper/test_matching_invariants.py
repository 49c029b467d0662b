"""What must not change the answer of state matching, and what can change it one way only."""

from dataclasses import replace

import numpy as np
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from smal import solve
from tests.smal.paper.matching import STRUCTURES, Problem, structured

TOLERANCE = 1e-5
structures = st.sampled_from([name for name in STRUCTURES if name != "rank deficient"])
seeds = st.integers(0, 2**31)
GENERATE = (Phase.explicit, Phase.generate)
examples = settings(max_examples=25, deadline=None, derandomize=True, phases=GENERATE, report_multiple_bugs=False)


def bounds(problem: Problem) -> tuple[float, float]:
    """Between what the optimum is."""
    solution = solve(problem.X, problem.Y, *problem.parameters, tolerance=TOLERANCE)
    assert solution.duality_gap <= TOLERANCE
    return solution.objective * (1 - solution.duality_gap) * (1 - 1e-6), solution.objective * (1 + 1e-6)


def overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


@examples
@given(structure=structures, seed=seeds)
def test_order_of_sequences_and_frames(structure: str, seed: int) -> None:
    problem, rng = structured(structure, seed), np.random.default_rng(seed)
    whole = problem.X.shape[1] // problem.length
    X = problem.X[:, : whole * problem.length]
    problem = replace(problem, X=X)
    columns = (rng.permutation(whole)[:, None] * problem.length + rng.permutation(problem.length)).ravel()
    permuted = replace(problem, X=np.asfortranarray(X[:, columns]), Y=problem.Y[:, rng.permutation(problem.Y.shape[1])])
    assert overlap(bounds(problem), bounds(permuted))


@examples
@given(structure=structures, seed=seeds, x=st.floats(0.01, 100), y=st.floats(0.01, 100), flip=st.booleans())
def test_scaling(structure: str, seed: int, x: float, y: float, flip: bool) -> None:
    problem = structured(structure, seed)
    X, Y = (problem.X * x * (-1.0 if flip else 1.0)).astype(np.float32), (problem.Y * y).astype(np.float32)
    scaled = Problem(X, Y, problem.length, problem.lambda1 * x, problem.lambda2 * x)
    low, high = bounds(problem)
    rounded = 1e-6 * float(np.linalg.norm(Y, axis=0).sum())  # scaling rounds float32
    assert overlap((low * y - rounded, high * y + rounded), bounds(scaled))


@examples
@given(structure=structures, seed=seeds, factor=st.floats(1.0, 5.0), which=st.sampled_from(["lambda1", "lambda2"]))
def test_more_penalty_never_lowers_the_optimum(structure: str, seed: int, factor: float, which: str) -> None:
    problem = structured(structure, seed)
    dearer = replace(problem, **{which: factor * getattr(problem, which)})
    assert bounds(problem)[0] <= bounds(dearer)[1]
    assert bounds(dearer)[0] <= factor * bounds(problem)[1]


@examples
@given(structure=structures, seed=seeds, count=st.integers(1, 4))
def test_more_templates_never_raise_the_optimum(structure: str, seed: int, count: int) -> None:
    problem, rng = structured(structure, seed), np.random.default_rng(seed)
    whole = problem.X.shape[1] - problem.X.shape[1] % problem.length
    problem = replace(problem, X=problem.X[:, :whole])
    new = rng.standard_normal((problem.X.shape[0], count * problem.length)) / np.sqrt(problem.X.shape[0])
    new[:, 0] += problem.Y[:, 0]
    more = replace(problem, X=np.asfortranarray(np.concatenate([problem.X, new], axis=1), dtype=np.float32))
    assert bounds(more)[0] <= bounds(problem)[1]
