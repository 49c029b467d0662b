"""A working set over template sequences for Eq. 7, with a duality gap of the full problem."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.block_newton import BlockProblem, BlockSolution, solve_blocks
from smal.certificate import cheap_polar_bounds, polar_bounds
from smal.gram import Columns, TemplateProducts

Array = NDArray[np.float64]

_FIRST_BLOCKS = 3
_MAX_ROUNDS = 100
_REFINEMENTS = 12


@dataclass(frozen=True)
class Matching:
    """One problem: what is known about all templates, and how to learn more about some.

    Parameters
    ----------
    correlations : float array (n, q)
        X^T Y.
    query_products : callable
        X_S^T Y in float64 (p, q) for chosen template frames S, as exactly as possible.
    products : TemplateProducts
    squares : float64 array (q,)
        ||y_i||^2, all positive.
    sequence_length : int
    lambda1, lambda2 : float
    tolerance : float
        Relative duality gap at which to stop.
    """

    correlations: NDArray[Any]
    query_products: Callable[[Columns], Array]
    products: TemplateProducts
    squares: Array
    sequence_length: int
    lambda1: float
    lambda2: float
    tolerance: float

    @property
    def slack(self) -> float:
        """How far a polar may exceed 1 without needing attention."""
        return 0.25 * self.tolerance

    def blocks(self, array: NDArray[Any]) -> NDArray[Any]:
        """View (n, q) as (k, l, q), the last block filled up with zeros."""
        n, q = array.shape
        missing = -n % self.sequence_length
        if missing:
            array = np.concatenate([array, np.zeros((missing, q), dtype=array.dtype)])
        return array.reshape(-1, self.sequence_length, q)

    def columns(self, working: Columns) -> Columns:
        """Template frames of the working sequences."""
        every = (working[:, None] * self.sequence_length + np.arange(self.sequence_length)).ravel()
        existing: Columns = every[every < self.correlations.shape[0]]
        return existing

    def polar(self, gradients: NDArray[Any], threshold: float) -> Array:
        """Bound the polar of every block, sharply where the cheap bound exceeds the threshold."""
        bounds = cheap_polar_bounds(gradients, self.lambda1, self.lambda2)
        doubtful = np.flatnonzero(bounds > threshold)
        if doubtful.size:
            exact = gradients[doubtful].astype(np.float64)
            guess = exact / (self.lambda1 + self.lambda2)
            bounds[doubtful] = polar_bounds(exact, self.lambda1, self.lambda2, guess, _REFINEMENTS)
        return bounds

    def without_templates(self) -> tuple[Array, float]:
        """Certify W = 0 by Theta = Y / ||Y||: bounds on the polars, and the lower bound of Eq. 7."""
        norms = np.sqrt(self.squares)
        bounds = self.polar(self.blocks(self.correlations) / norms, threshold=1.0)
        return bounds, float(norms.sum()) / max(1.0, float(bounds.max(initial=0.0)))


class _Restriction:
    """Eq. 7 on some template sequences, lengths scaled to 1, and its solution."""

    def __init__(self, matching: Matching, working: Columns) -> None:
        self.matching, self.working = matching, working
        self.columns = matching.columns(working)
        gram, correlations = matching.products.gram(self.columns), matching.query_products(self.columns)
        self.template_scale = float(np.sqrt(gram.diagonal().max(initial=0.0))) or 1.0
        self.query_scale = float(np.sqrt(matching.squares.max()))
        missing = -self.columns.size % matching.sequence_length
        self.problem = BlockProblem(
            np.pad(gram / self.template_scale**2, ((0, missing), (0, missing))),
            np.pad(correlations / (self.template_scale * self.query_scale), ((0, missing), (0, 0))),
            matching.squares / self.query_scale**2,
            matching.lambda1 / self.template_scale,
            matching.lambda2 / self.template_scale,
            matching.sequence_length,
        )

    def solve(self, known: Columns, weights: Array, tolerance: float) -> BlockSolution:
        """Solve, starting from the weights (p', q) of some of the template frames."""
        start = np.zeros_like(self.problem.correlations)
        start[np.searchsorted(self.columns, known)] = weights * (self.template_scale / self.query_scale)
        return solve_blocks(self.problem, start, tolerance)

    def unscaled(self, weights: Array) -> Array:
        """Weights of the actual, not scaled, template frames."""
        return np.asarray(weights[: self.columns.size] * (self.query_scale / self.template_scale))

    def certify(self, inner: BlockSolution) -> tuple[Array, float]:
        """Extend the dual point to all templates: bounds on all polars, and the lower bound of Eq. 7."""
        matching, problem = self.matching, self.problem
        alpha = inner.query_shares / self.query_scale
        used = matching.products.correlate(self.columns, inner.dual_weights[: self.columns.size] / self.template_scale)
        gradients = matching.blocks(matching.correlations * alpha.astype(matching.correlations.dtype) - used)
        bounds = matching.polar(gradients, threshold=1.0 + matching.slack)
        # The working sequences lie on the edge of the dual set, where only the solver's subgradients are sharp.
        sharp = problem.blocks(problem.correlations * inner.query_shares - problem.gram @ inner.dual_weights)
        rows = problem.blocks(inner.rows)
        bounds[self.working] = polar_bounds(sharp, problem.lambda1, problem.lambda2, rows, rounds=2)
        value = (inner.query_shares * problem.squares).sum() - (problem.correlations * inner.dual_weights).sum()
        return bounds, float(value) * self.query_scale / max(1.0, float(bounds.max()))


def _without_crumbs(problem: BlockProblem, weights: Array, allowed: float) -> Array:
    """Set rows, and columns of blocks, to zero that differ from it by the smoothing only."""
    ceiling = problem.objective(weights) * (1.0 + allowed)
    best = weights
    for share in (1e-4, 1e-3, 1e-2):
        squares = np.square(weights)
        rows = np.sqrt(squares.sum(axis=1))
        columns = np.sqrt(problem.blocks(squares).sum(axis=1, keepdims=True))
        in_row = np.broadcast_to((rows > share * rows.max())[:, None], weights.shape)
        kept = problem.blocks(in_row) & (columns > share * columns.max())
        candidate = np.where(kept, problem.blocks(weights), 0.0).reshape(weights.shape)
        if problem.objective(candidate) > ceiling:
            break
        best = candidate
    return best


def _grow(bounds: Array, working: Columns, slack: float) -> Columns:
    """Add the sequences that violate the dual point most, as many as there are already."""
    violating = np.setdiff1d(np.flatnonzero(bounds > 1.0 + slack), working, assume_unique=True)
    worst = violating[np.argsort(-bounds[violating], kind="stable")]
    return np.union1d(working, worst[: max(_FIRST_BLOCKS, working.size)])


@dataclass(frozen=True)
class Outcome:
    """Template frames that may have weight, their weights, residual norms, objective, lower bound, Newton steps."""

    columns: Columns
    weights: Array
    residual_norms: Array
    objective: float
    lower_bound: float
    steps: int


def minimise(matching: Matching, warm_blocks: Columns) -> Outcome:
    """Grow a working set until the gap of the full problem is within the tolerance.

    Parameters
    ----------
    matching : Matching
    warm_blocks : intp array
        Template sequences to start with, for instance those that a similar query used.
    """
    norms = np.sqrt(matching.squares)
    columns, weights = np.zeros(0, dtype=np.intp), np.zeros((0, norms.size))
    bounds, lower = matching.without_templates()
    outcome = Outcome(columns, weights, norms, float(norms.sum()), lower, 0)
    working = _grow(bounds, warm_blocks, matching.slack)
    tolerance, steps = 0.3 * matching.tolerance, 0
    for _ in range(_MAX_ROUNDS):
        if outcome.objective - outcome.lower_bound <= matching.tolerance * outcome.objective or not working.size:
            break
        part = _Restriction(matching, working)
        inner = part.solve(columns, weights, tolerance)
        steps += inner.steps
        bounds, lower = part.certify(inner)
        cleaned = _without_crumbs(part.problem, inner.weights, 0.2 * matching.tolerance)
        residuals = part.problem.residual_norms(cleaned) * part.query_scale
        objective = part.problem.objective(cleaned) * part.query_scale
        outcome = Outcome(part.columns, part.unscaled(cleaned), residuals, objective, lower, steps)
        columns, weights = part.columns, part.unscaled(inner.weights)
        grown = _grow(bounds, working, matching.slack)
        if grown.size == working.size:
            # No sequence is missing: the restricted solution itself must become sharper, or has reached its limit.
            if inner.gap > tolerance or tolerance < 1e-3 * matching.tolerance:
                break
            tolerance *= 0.3
        working = grown
    return outcome
