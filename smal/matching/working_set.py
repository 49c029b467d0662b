"""A working set of template frames for Eq. 7, grown until a duality gap of the full problem is small.

1. Guess which sequences matter, solve Eq. 7 on them alone (`block_newton`), and drop the frames that get no weight.
2. Extend the dual point of that solution to other sequences (`screening`), first to the likely ones, then to all.
   Sequences that it does not rule out enter the working set.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smal.matching.block_newton import FIRST_EPSILON, BlockSolution, solve_blocks
from smal.matching.block_problem import BlockProblem, block_objective, smoothing_for
from smal.matching.certificate import bound_by_lengths
from smal.matching.inner_products import Columns, DualPoint, InnerProducts, common
from smal.matching.narrow_product import rounding
from smal.matching.screening import Penalty, Screening, Violations
from smal.objective import l21_norm, s1_norm, sequence_starts

Array = NDArray[np.float64]

# Sequences to start with, and those that are looked at before all others.
_FIRST, _LIKELY = 4, 48
_MAX_ROUNDS = 200
# A row whose smoothed subgradient is shorter has no weight.
_ALIVE = 0.8
# Rounded products show violations of this size.
_VISIBLE = 1e-3
# A polar, the objective and their quotient take fewer operations, beside the terms of their sums.
_OPERATIONS = 32
# Gap to which Eq. 7 is solved while the likely sequences are being sorted out.
_LOOSE = 1e-2


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


@dataclass(frozen=True)
class _Start:
    """Weights and subgradients (U and V) of some template frames, and the smoothing that suits them."""

    columns: Columns
    weights: Array
    U: Array
    V: Array
    epsilon: float


class _Restriction:
    """Eq. 7 on some template frames, lengths scaled to 1, and its solution."""

    def __init__(self, products: InnerProducts, penalty: Penalty, columns: Columns) -> None:
        self.columns = columns
        gram, correlations = products.restricted(columns)
        self.template_scale = float(np.sqrt(gram.diagonal().max(initial=0.0))) or 1.0
        self.query_scale = float(np.sqrt(products.squares.max()))
        self.problem = BlockProblem(
            gram / self.template_scale**2,
            correlations / (self.template_scale * self.query_scale),
            products.squares / self.query_scale**2,
            penalty.lambda1 / self.template_scale,
            penalty.lambda2 / self.template_scale,
            np.append(sequence_starts(columns, penalty.sequence_length), columns.size),
        )
        self.weight_scale = self.query_scale / self.template_scale

    def solve(self, start: _Start, tolerance: float) -> BlockSolution:
        """Solve, starting from what is known of some template frames, not all of which need be here."""
        weights, U, V = (np.zeros_like(self.problem.correlations) for _ in range(3))
        here, there = common(self.columns, start.columns)
        weights[here] = start.weights[there] / self.weight_scale
        U[here], V[here] = start.U[there], start.V[there]
        return solve_blocks(self.problem, weights, tolerance, start.epsilon, (U, V))

    def dual_point(self, inner: BlockSolution) -> DualPoint:
        """Theta in terms of actual, not scaled, frames."""
        shares, weights = inner.alpha / self.query_scale, inner.B / self.template_scale
        return DualPoint(shares, self.columns, weights, inner.U)

    def dual_value(self, inner: BlockSolution) -> float:
        """<Theta, Y>."""
        value = (inner.alpha * self.problem.squares).sum()
        return float(value - (self.problem.correlations * inner.B).sum()) * self.query_scale

    def epsilon_for(self, gap: float, inner: BlockSolution) -> float:
        """Smoothing that costs about as much as the gap."""
        wanted = smoothing_for(self.problem, gap * block_objective(self.problem, inner.weights))
        return min(max(wanted, inner.epsilon), FIRST_EPSILON)


def _rounded_to_zero(problem: BlockProblem, weights: Array, allowed: float) -> Array:
    """Set the rows and columns of blocks to zero that have weight only because norms are smoothed."""
    ceiling = block_objective(problem, weights) * (1.0 + allowed)
    squares = np.square(weights)
    rows = np.sqrt(squares.sum(axis=1))
    columns = np.sqrt(np.add.reduceat(squares, problem.starts[:-1])) if len(weights) else squares
    of_row = np.repeat(np.arange(len(columns)), np.diff(problem.starts))
    best = weights
    for share in (1e-4, 1e-3, 1e-2):
        kept = (rows > share * rows.max(initial=0.0))[:, None]
        kept = kept & (columns > share * columns.max(initial=0.0))[of_row]
        candidate = np.where(kept, weights, 0.0)
        if block_objective(problem, candidate) > ceiling:
            break
        best = candidate
    return best


class _Search:
    """The working set, the best solution on it, and what rules the other sequences out."""

    def __init__(self, products: InnerProducts, penalty: Penalty, warm: Columns) -> None:
        self.products, self.penalty = products, penalty
        self.screening = Screening(products, penalty)
        norms = np.sqrt(products.squares)
        likely = _likely(products, norms, penalty.sequence_length)
        self.likely = np.union1d(likely, warm)
        self.columns = self.screening.frames(np.union1d(likely[:_FIRST], warm))
        # Frames that came back after they had been dropped: they stay, or the search might go round in circles.
        self.dropped, self.kept = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
        nothing, none = np.zeros(0, dtype=np.intp), np.zeros((0, norms.size))
        self.start, self.steps = _Start(nothing, none, none, none, FIRST_EPSILON), 0
        self.outcome = Outcome(nothing, none, norms, float(norms.sum()), 0.0, 0)
        #: Share of the objective by which rounded products kept the last bound from being better.
        self.lost = 0.0

    def solve(self, tolerance: float) -> None:
        """Solve on the working set."""
        self.part = _Restriction(self.products, self.penalty, self.columns)
        self.inner = self.part.solve(self.start, tolerance)
        self.steps += self.inner.steps
        self.dual = self.part.dual_point(self.inner)

    def probe(self, threshold: float) -> Violations:
        """Look at the likely sequences only."""
        return self.screening.probe(self.dual, self.likely, threshold)

    def certify(self) -> Violations:
        """Extend the dual point to all sequences, which bounds the optimum from below; clean the solution up."""
        violations = self.screening.extend(self.dual)
        part = self.part
        scaled = _rounded_to_zero(part.problem, self.inner.weights, 0.2 * self.penalty.tolerance)
        weights = scaled * part.weight_scale
        # The best weights and the best bound need not come from the same round.
        best, penalty = self.outcome, self.penalty
        residuals = self.products.residual_norms(self.columns, weights)
        objective = float(residuals.sum()) + penalty.lambda1 * l21_norm(weights)
        objective += penalty.lambda2 * s1_norm(weights, penalty.sequence_length, self.columns)
        known, largest = self.products.dual_bounds(self.dual), self.screening.largest
        sure = known.value / max(largest + self._polar_of(known.entries), known.length, 1.0)
        sure *= 1.0 - rounding(weights.size + penalty.sequence_length + residuals.size + _OPERATIONS, np.float64)
        self.lost = (part.dual_value(self.inner) / largest - sure) / objective
        lower_bound = max(sure, best.lower_bound)
        if objective <= best.objective:
            best = Outcome(self.columns, weights, residuals, objective, lower_bound, self.steps)
        self.outcome = replace(best, lower_bound=lower_bound, steps=self.steps)
        return violations

    def _polar_of(self, entries: Array) -> float:
        """Bound the polar of an error of X_j^T Theta whose entries are no larger than these (q,)."""
        row = float(np.linalg.norm(entries))
        column = float(np.sqrt(self.penalty.sequence_length) * entries.max())
        return bound_by_lengths(row, column, self.penalty.lambda1, self.penalty.lambda2)

    def lacking(self, violations: Violations) -> Columns:
        """Frames of the worst violations that are not in the working set, ascending."""
        working = np.unique(self.columns // self.penalty.sequence_length).size
        frames: Columns = np.setdiff1d(violations.worst(max(_FIRST, working)), self.columns)
        return frames

    def grow(self, lacking: Columns, violations: Violations) -> None:
        """Add frames, drop those without weight, and smooth as much as the violations ask for."""
        inner = self.inner
        alive = np.linalg.norm(inner.U, axis=1) >= _ALIVE
        self.kept = np.union1d(self.kept, np.intersect1d(lacking, self.dropped))
        stay = self.columns[alive | np.isin(self.columns, self.kept)]
        self.dropped = np.union1d(self.dropped, np.setdiff1d(self.columns, stay))
        excess = 1.0 - 1.0 / violations.polars.max(initial=1.0)
        epsilon, weights = self.part.epsilon_for(excess, inner), inner.weights * self.part.weight_scale
        self.start = _Start(self.columns, weights, inner.U, inner.V, epsilon)
        self.columns = np.union1d(stay, lacking)


def _likely(products: InnerProducts, norms: Array, length: int) -> Columns:
    """Sequences by how much they resemble the query at a first guess, best first."""
    guess = np.square(products.guess() / norms.astype(np.float32)).sum(axis=1)
    scores = np.add.reduceat(guess, np.arange(0, guess.size, length))
    best = np.argpartition(-scores, _LIKELY)[:_LIKELY] if scores.size > _LIKELY else np.arange(scores.size)
    ordered: Columns = best[np.lexsort((best, -scores[best]))]
    return ordered


def minimise(products: InnerProducts, penalty: Penalty, warm_blocks: Columns) -> Outcome:
    """Grow a working set until the gap of the full problem is within the tolerance.

    Products that are not exact (`InnerProducts.dual_rounding`) may keep it from getting there; then it ends early.

    Parameters
    ----------
    products : InnerProducts
        Every query frame has a length above 0.
    penalty : Penalty
    warm_blocks : intp array
        Template sequences to start with, for instance those that a similar query used.
    """
    search = _Search(products, penalty, warm_blocks)
    finest = 0.3 * penalty.tolerance
    tolerance, everywhere = (finest, True) if warm_blocks.size else (max(_LOOSE, finest), False)
    for _ in range(_MAX_ROUNDS):
        search.solve(tolerance)
        violations = search.certify() if everywhere else search.probe(1.0 + max(tolerance, _VISIBLE))
        lacking = search.lacking(violations)
        if not (everywhere or lacking.size) and tolerance <= finest:
            everywhere = True
            violations = search.certify()
            lacking = search.lacking(violations)
        if everywhere and (search.outcome.gap <= penalty.tolerance or search.lost > 0.5 * penalty.tolerance):
            break
        if not lacking.size:
            # Nothing is missing: the restricted solution itself must become sharper, or has reached its limit.
            if tolerance < 1e-3 * penalty.tolerance:
                break
            tolerance = finest if tolerance > finest else 0.3 * tolerance
        search.grow(lacking, violations)
    return search.outcome
