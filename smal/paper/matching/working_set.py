"""A working set of template frames for Eq. 7, grown until a duality gap of the full problem is small.

1. Guess which sequences matter, solve Eq. 7 on them alone (`newton`), and drop the frames that get no weight.
2. Extend the dual point of that solution to other sequences (`certificate`), first to the likely ones, then to all.
   Sequences that it does not rule out enter the working set.

Bounds on the polars come from products in float32, with the error of these added, and follow the dual point when it
moves. So a bound never rules out a sequence that the solution needs; the few that stay in doubt are looked at with
products in float64.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smal.paper.matching.certificate import polar_bounds
from smal.paper.matching.newton import (
    FIRST_EPSILON,
    BlockProblem,
    Iterate,
    block_objective,
    smoothing_for,
    solve_blocks,
)
from smal.paper.matching.products import Columns, Products, rounding
from smal.paper.objective import l21_norm, s1_norm, sequence_starts

Array = NDArray[np.float64]

# Sequences to start with, those that are looked at before all others, and those looked at in float64 at a time.
_FIRST, _LIKELY, _MOST_EXACT = 4, 48, 64
_MAX_ROUNDS = 200
# Alternating projections: from products in float32, and from exact ones.
_QUICK, _THOROUGH = 8, 100
# A row whose smoothed subgradient is shorter has no weight; one is worth a weight if the dual point holds it so far.
_ALIVE, _TIGHT = 0.8, 0.7
# Gap to which Eq. 7 is solved while the likely sequences are being sorted out; products in float32 show violations so
# small.
_LOOSE, _VISIBLE = 1e-2, 1e-3
# The objective and its quotient with the bound take fewer operations, beside the terms of their sums.
_OPERATIONS = 32


@dataclass(frozen=True)
class Penalty:
    """What Eq. 7 charges, and the relative duality gap at which to stop."""

    sequence_length: int
    lambda1: float
    lambda2: float
    tolerance: float


@dataclass(frozen=True)
class Outcome:
    """Template frames that may have weight, their weights, residual norms, objective, lower bound, Newton steps."""

    columns: Columns
    weights: Array
    residual_norms: Array
    objective: float
    lower_bound: float
    steps: int

    @property
    def gap(self) -> float:
        """Relative duality gap."""
        return 1.0 - self.lower_bound / self.objective if self.objective > 0.0 else 0.0


def _rounded_to_zero(problem: BlockProblem, weights: Array, allowed: float) -> Array:
    """Set the rows and columns of blocks to zero that have weight only because norms are smoothed."""
    ceiling = block_objective(problem, weights) * (1.0 + allowed)
    squares = np.square(weights)
    rows = np.sqrt(squares.sum(axis=1, keepdims=True))
    columns = np.sqrt(np.add.reduceat(squares, problem.starts[:-1])) if len(weights) else squares
    columns = np.repeat(columns, np.diff(problem.starts), axis=0)
    for share in (1e-2, 1e-3, 1e-4):
        kept = (rows > share * rows.max(initial=0.0)) & (columns > share * columns.max(initial=0.0))
        candidate = np.where(kept, weights, 0.0)
        if block_objective(problem, candidate) <= ceiling:
            return candidate
    return weights


class _Search:
    """The working set, the best solution on it, and what rules the other sequences out."""

    def __init__(self, products: Products, penalty: Penalty) -> None:
        self.products, self.penalty = products, penalty
        n, q, length = products.lengths.size, products.norms.size, penalty.sequence_length
        #: Bounds on the polars of all sequences at the dual point that was extended last.
        self.polars, self.extended = np.full(-(-n // length), np.inf), np.zeros((0, 0))
        guess = np.square(products.guess() / products.norms.astype(np.float32)).sum(axis=1)
        likely = np.argsort(-np.add.reduceat(guess, np.arange(0, n, length)), kind="stable")[:_LIKELY]
        self.likely, self.columns = np.sort(likely), self.frames(np.sort(likely[:_FIRST]))
        nothing, none = np.zeros(0, dtype=np.intp), np.zeros((0, q))
        # Frames that came back after they had been dropped: they stay, or the search might go round in circles.
        self.dropped, self.kept = nothing, nothing
        #: W, U and V of some template frames, to start from.
        self.known, self.known_columns, self.epsilon = (none, none, none), nothing, FIRST_EPSILON
        self.outcome = Outcome(nothing, none, products.norms, float(products.norms.sum()), 0.0, 0)
        self.steps = 0
        #: The largest polar that was too large when sequences were last examined.
        self.worst = 1.0

    def frames(self, blocks: Columns) -> Columns:
        """Template frames of sequences."""
        length = self.penalty.sequence_length
        every = (blocks[:, None] * length + np.arange(length)).ravel()
        existing: Columns = every[every < self.products.lengths.size]
        return existing

    def solve(self, tolerance: float) -> None:
        """Solve Eq. 7 on the working set, lengths scaled to 1."""
        products, penalty, columns = self.products, self.penalty, self.columns
        gram, correlations = products.restricted(columns)
        template_scale = float(np.sqrt(gram.diagonal().max(initial=0.0))) or 1.0
        query_scale = float(products.norms.max())
        self.weight_scale = query_scale / template_scale
        self.problem = BlockProblem(
            gram / template_scale**2,
            correlations / (template_scale * query_scale),
            (products.norms / query_scale) ** 2,
            penalty.lambda1 / template_scale,
            penalty.lambda2 / template_scale,
            np.append(sequence_starts(columns, penalty.sequence_length), columns.size),
        )
        _, here, there = np.intersect1d(columns, self.known_columns, assume_unique=True, return_indices=True)
        W, U, V = (np.zeros_like(correlations) for _ in range(3))
        for part, known in zip((W, U, V), self.known, strict=True):
            part[here] = known[there]
        start = Iterate(W / self.weight_scale, np.zeros(len(products.norms)), np.zeros_like(W), U, V)
        self.inner, self.epsilon, steps = solve_blocks(self.problem, start, self.epsilon, tolerance)
        self.steps += steps
        self.dual = products.dual_point(self.inner.alpha / query_scale, columns, self.inner.B / template_scale)

    def examine(self, blocks: Columns, exact: bool, certain: bool, enough: float) -> Columns:
        """Bound polars of some sequences; return the frames that the worst violations want in the working set.

        Parameters
        ----------
        blocks : intp array
            Template sequences, ascending.
        exact : bool
            Multiply in float64.
        certain : bool
            Whether errors of products count, and the bounds are kept.
        enough : float
            Bound that is no violation.
        """
        frames, (length, lambda1, lambda2) = self.frames(blocks), self.lambdas
        multiply = self.products.exact if exact else self.products.correlate
        gradients, radii = multiply(self.dual, frames)
        U = gradients / (lambda1 + lambda2)
        if lambda1 > 0.0:
            # Where the columns are at the edge of their balls, rows without weight have to do without them.
            solved = np.isin(frames // length, self.columns // length)
            U[solved] = gradients[solved] / lambda1
        _, here, there = np.intersect1d(frames, self.columns, assume_unique=True, return_indices=True)
        U[here] = self.inner.U[there]
        split, bounds = (U.astype(np.float64), np.zeros(gradients.shape)), np.empty(blocks.size)
        starts = np.append(sequence_starts(frames, length), frames.size)
        radii, rounds = radii if certain else np.zeros_like(radii), _THOROUGH if exact else _QUICK
        polar_bounds(gradients, radii, starts, (lambda1, lambda2), split, rounds, enough, bounds)
        if certain:
            self.polars[blocks] = bounds
        if certain and not exact:
            return frames[:0]
        self.worst = max(self.worst, float(bounds.max(initial=1.0)))
        outside = np.flatnonzero(bounds > enough)
        most = max(_FIRST, np.unique(self.columns // length).size)
        outside = blocks[outside[np.argsort(-bounds[outside], kind="stable")[:most]]]
        tight = np.linalg.norm(gradients - lambda2 * split[1], axis=1) >= _TIGHT * lambda1
        lacking: Columns = np.setdiff1d(frames[tight & np.isin(frames // length, outside)], self.columns)
        return lacking

    @property
    def lambdas(self) -> tuple[int, float, float]:
        """l, lambda1 and lambda2."""
        return self.penalty.sequence_length, self.penalty.lambda1, self.penalty.lambda2

    def probe(self, enough: float) -> Columns:
        """Look at the likely sequences only; return the frames that are lacking."""
        return self.examine(self.likely, exact=False, certain=False, enough=enough)

    def certify(self) -> Columns:
        """Bound all polars, and with them the optimum from below; return the frames that are lacking."""
        self._follow()
        # A polar may exceed 1 by so much without needing attention.
        enough = 1.0 + 0.25 * self.penalty.tolerance
        self.examine(np.flatnonzero(self.polars > enough), exact=False, certain=True, enough=enough)
        # The sequences that the dual point was made for lie on the edge of the dual set: only exact products tell.
        working = np.unique(self.columns // self.penalty.sequence_length)
        lacking = self.examine(working, exact=True, certain=True, enough=enough)
        others = np.setdiff1d(np.flatnonzero(self.polars > enough), working)
        others = others[np.argsort(-self.polars[others], kind="stable")]
        for start in range(0, others.size, _MOST_EXACT):
            chosen = np.sort(others[start : start + _MOST_EXACT])
            lacking = np.union1d(lacking, self.examine(chosen, exact=True, certain=True, enough=enough))
            if lacking.size:
                break
        self._evaluate()
        return lacking

    def _follow(self) -> None:
        """Move the bounds with the dual point: a polar is a norm, so it grows at most by that of the movement."""
        before, self.extended = self.extended, self.dual.theta
        if not before.size:
            return
        spectral, longest = self.products.movement(before, self.extended)
        length, lambda1, lambda2 = self.lambdas
        lengths = np.pad(self.products.lengths, (0, -self.products.lengths.size % length)).reshape(-1, length)
        rows = np.maximum(lengths.max(axis=1) * spectral, 1e-150)
        columns = np.maximum(np.linalg.norm(lengths, axis=1) * longest, 1e-150)
        self.polars += 1.0 / (lambda1 / rows + lambda2 / columns)

    def _evaluate(self) -> None:
        """Clean the solution up and find its objective; the best one and the best bound may be of different rounds."""
        penalty, best = self.penalty, self.outcome
        weights = _rounded_to_zero(self.problem, self.inner.W, 0.2 * penalty.tolerance) * self.weight_scale
        residuals = self.products.residual_norms(self.columns, weights)
        objective = float(residuals.sum()) + penalty.lambda1 * l21_norm(weights)
        objective += penalty.lambda2 * s1_norm(weights, penalty.sequence_length, self.columns)
        longest = float(np.linalg.norm(self.extended, axis=1).max()) * (1.0 + self.products.rounding)
        bound = self.products.dual_value(self.extended) / max(float(self.polars.max()), longest, 1.0)
        bound *= 1.0 - rounding(weights.size + penalty.sequence_length + residuals.size + _OPERATIONS, np.float64)
        bound = max(bound, best.lower_bound)
        if objective <= best.objective:
            best = Outcome(self.columns, weights, residuals, objective, bound, self.steps)
        self.outcome = replace(best, lower_bound=bound, steps=self.steps)

    def grow(self, lacking: Columns) -> None:
        """Add frames, drop those without weight, and smooth as much as the violations ask for."""
        inner = self.inner
        alive = np.linalg.norm(inner.U, axis=1) >= _ALIVE
        self.kept = np.union1d(self.kept, np.intersect1d(lacking, self.dropped))
        stay = self.columns[alive | np.isin(self.columns, self.kept)]
        self.dropped = np.union1d(self.dropped, np.setdiff1d(self.columns, stay))
        excess = (1.0 - 1.0 / self.worst) * block_objective(self.problem, inner.W)
        self.epsilon = min(max(smoothing_for(self.problem, excess), self.epsilon), FIRST_EPSILON)
        self.known, self.known_columns = (inner.W * self.weight_scale, inner.U, inner.V), self.columns
        self.columns, self.worst = np.union1d(stay, lacking), 1.0


def minimize(products: Products, penalty: Penalty) -> Outcome:
    """Grow a working set until the gap of the full problem is within the tolerance.

    Rounding may keep it from getting there; then it ends early.

    Parameters
    ----------
    products : Products
        Every query frame has a length above 0.
    penalty : Penalty
    """
    search, finest = _Search(products, penalty), 0.3 * penalty.tolerance
    # Where products are known, looking at all sequences costs no more than looking at the likely ones.
    tolerance, everywhere = (max(_LOOSE, finest), False) if products.known is None else (finest, True)
    for _ in range(_MAX_ROUNDS):
        search.solve(tolerance)
        lacking = search.certify() if everywhere else search.probe(1.0 + max(tolerance, _VISIBLE))
        if not (everywhere or lacking.size) and tolerance <= finest:
            everywhere, lacking = True, search.certify()
        if everywhere and search.outcome.gap <= penalty.tolerance:
            break
        if not lacking.size:
            # Nothing is missing: the restricted solution itself must become sharper, or has reached its limit.
            if tolerance < 1e-3 * penalty.tolerance:
                break
            tolerance = finest if tolerance > finest else 0.3 * tolerance
        search.grow(lacking)
    return search.outcome
