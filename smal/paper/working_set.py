"""A working set of template frames for Eq. 7, grown until the duality gap of the full problem is small.

1. Solve Eq. 7 on the working set alone (`newton`), which gives a point Theta of the dual problem as well.
2. Bound the polars of all template sequences at Theta (`duality_gap`): first of the likely ones, then of all.
3. Stop if the gap is within the tolerance; otherwise add the frames of the sequences whose polar exceeds 1, and drop
   those without weight.

One product of all templates with Theta in float32, with a bound on what rounding does to it, rules nearly all
sequences out; the others are multiplied in float64. So no bound is too low.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.paper.duality_gap import bound_by_lengths, polar_bounds, quick_bounds, rounding
from smal.paper.newton import FIRST_EPSILON, BlockProblem, Iterate, minimize
from smal.paper.objective import l21_norm, s1_norm

Array = NDArray[np.float64]
Columns = NDArray[np.intp]

# Sequences to start with, and those that are looked at before all others.
_FIRST, _LIKELY = 4, 48
_MAX_ROUNDS = 200
# Alternating projections: to see which sequences are lacking, and to bound polars.
_QUICK, _THOROUGH = 8, 100
# A row whose smoothed subgradient is shorter has no weight; one is worth a weight if the dual point holds it so far.
_ALIVE, _TIGHT = 0.8, 0.7
# Gap to which Eq. 7 is solved while the likely sequences are being sorted out.
_LOOSE = 1e-2
# The objective and its quotient with the bound take fewer operations, beside the terms of their sums.
_OPERATIONS = 32


class WorkingSet:
    """The working set, the best solution on it, and the best lower bound on the optimum of the full problem.

    Template frames are rows (n, m), query frames rows (q, m), none of which is zero.
    """

    def __init__(
        self, rows: NDArray[np.float32], query: Array, length: int, lambda1: float, lambda2: float, tolerance: float
    ) -> None:
        self.rows, self.query, self.length, self.tolerance = rows, query, length, tolerance
        self.lambda1, self.lambda2 = lambda1, lambda2
        (n, m), q = rows.shape, len(query)
        #: Bound on the relative error of inner products of frames in float64, and of sums of these.
        self.rounding = rounding(m + q + 2)
        #: ||y_i||, rounded up.
        self.norms: Array = np.linalg.norm(query, axis=1) * (1.0 + self.rounding)
        with np.errstate(over="ignore", invalid="ignore"):
            squares, guess = (
                np.einsum("rm,rm->r", rows, rows),
                rows @ (query / self.norms[:, None]).astype(np.float32).T,
            )
        # NaN or infinity anywhere in X shows in these.
        if not np.isfinite(squares).all():
            raise ValueError("templates contain NaN or infinity, or overflow float32 products")
        underflow = m * float(np.finfo(np.float32).tiny)
        #: ||x_r||, rounded up.
        self.lengths: Array = np.sqrt(squares.astype(np.float64) * (1.0 + rounding(m, np.float32)) + underflow)

        alike = np.add.reduceat(np.square(guess).sum(axis=1), np.arange(0, n, length))
        likely = np.argsort(-alike, kind="stable")[:_LIKELY]
        self.likely, self.columns = np.sort(likely), self.frames(np.sort(likely[:_FIRST]))
        nothing, self.steps, self.epsilon = np.zeros(0, dtype=np.intp), 0, FIRST_EPSILON
        # Frames that came back after they had been dropped: they stay, or the search might go round in circles.
        self.dropped, self.kept = nothing, nothing
        #: W, U and V of the last working set, to start from.
        self.before: tuple[Columns, tuple[Array, ...]] = nothing, (np.zeros((0, q)),) * 3
        #: Inner products of the frames that were ever in the working set, in float64.
        self.known, self.exact_rows = nothing, np.zeros((0, m))
        self.gram, self.correlations = np.zeros((0, 0)), np.zeros((0, q))

        self.best_columns, self.weights, self.residuals = nothing, np.zeros((0, q)), self.norms
        self.objective, self.lower_bound = float(self.norms.sum()), 0.0

    @property
    def gap(self) -> float:
        """Relative duality gap of the full problem."""
        return 1.0 - self.lower_bound / self.objective

    def grow_until_certified(self) -> None:
        """Grow the working set until the gap of the full problem is within the tolerance.

        Rounding may keep it from getting there; then it ends early.
        """
        finest, everywhere = 0.3 * self.tolerance, False
        tolerance = max(_LOOSE, finest)
        for _ in range(_MAX_ROUNDS):
            self.solve(tolerance)
            lacking = self.certify() if everywhere else self.probe(1.0 + tolerance)
            if not (everywhere or lacking.size) and tolerance <= finest:
                everywhere, lacking = True, self.certify()
            if everywhere and self.gap <= self.tolerance:
                return
            if not lacking.size:
                # Nothing is missing: the restricted solution itself must become sharper, or has reached its limit.
                if tolerance < 1e-3 * self.tolerance:
                    return
                tolerance = finest if tolerance > finest else 0.3 * tolerance
            self.grow(lacking)

    def frames(self, blocks: Columns) -> Columns:
        """Template frames of sequences."""
        every = (blocks[:, None] * self.length + np.arange(self.length)).ravel()
        existing: Columns = every[every < len(self.rows)]
        return existing

    def as_blocks(self, blocks: Columns, values: NDArray[Any]) -> NDArray[Any]:
        """Shape what belongs to the frames of sequences (r, q) as (b, l, q); the last one may be shorter."""
        missing = blocks.size * self.length - len(values)
        padded = np.pad(values, ((0, missing), (0, 0))) if missing else values
        return padded.reshape(blocks.size, self.length, values.shape[1])

    def solve(self, tolerance: float) -> None:
        """Solve Eq. 7 on the working set, lengths scaled to 1."""
        columns = self.columns
        gram, correlations = self.products(columns)
        template_scale = float(np.sqrt(gram.diagonal().max(initial=0.0))) or 1.0
        query_scale = float(self.norms.max())
        self.weight_scale = query_scale / template_scale
        self.problem = BlockProblem(
            gram / template_scale**2,
            correlations / (template_scale * query_scale),
            (self.norms / query_scale) ** 2,
            self.lambda1 / template_scale,
            self.lambda2 / template_scale,
            columns,
            self.length,
        )
        _, here, there = np.intersect1d(columns, self.before[0], assume_unique=True, return_indices=True)
        W, U, V = (np.zeros_like(correlations) for _ in range(3))
        for part, known in zip((W, U, V), self.before[1], strict=True):
            part[here] = known[there]
        start = Iterate(W / self.weight_scale, np.zeros(len(self.query)), np.zeros_like(W), U, V)
        self.inner, self.epsilon, steps = minimize(self.problem, start, self.epsilon, tolerance)
        self.before = columns, (self.inner.W * self.weight_scale, self.inner.U, self.inner.V)
        self.steps += steps
        self.worst = 1.0
        explained = self.combine(columns, self.inner.B / template_scale)
        #: The dual point, a row a query frame (q, m).
        self.theta: Array = (self.inner.alpha / query_scale)[:, None] * self.query - explained

    def products(self, columns: Columns) -> tuple[Array, Array]:
        """X_S^T X_S (p, p) and X_S^T Y (p, q) in float64: a residual near zero needs the digits."""
        new = np.setdiff1d(columns, self.known)
        if new.size:
            fresh = self.rows[new].astype(np.float64)
            across = self.exact_rows @ fresh.T
            self.gram = np.block([[self.gram, across], [across.T, fresh @ fresh.T]])
            self.correlations = np.concatenate([self.correlations, fresh @ self.query.T])
            self.exact_rows, self.known = np.concatenate([self.exact_rows, fresh]), np.append(self.known, new)
        places = self.places(columns)
        return self.gram[np.ix_(places, places)], self.correlations[places]

    def places(self, columns: Columns) -> Columns:
        """Where template frames are among those that were ever in the working set."""
        order = np.argsort(self.known)
        found: Columns = order[np.searchsorted(self.known, columns, sorter=order)]
        return found

    def combine(self, columns: Columns, weights: Array) -> Array:
        """Sum of the frames S with weights (p, q), as rows (q, m)."""
        every = np.zeros((self.known.size, weights.shape[1]))
        every[self.places(columns)] = weights
        combined: Array = every.T @ self.exact_rows
        return combined

    def probe(self, enough: float) -> Columns:
        """Look at the likely sequences only; return the frames that are lacking."""
        values = self.rows[self.frames(self.likely)] @ self.theta.astype(np.float32).T
        return self.examine(self.likely, values.astype(np.float64), _QUICK, enough)[1]

    def certify(self) -> Columns:
        """Bound all polars, and with them the optimum from below; return the frames that are lacking."""
        n, m = self.rows.shape
        size = float(np.linalg.norm(self.theta))
        # A polar may exceed 1 by so much without needing attention.
        enough = 1.0 + 0.25 * self.tolerance
        every = np.arange(-(-n // self.length))
        values = self.rows @ self.theta.astype(np.float32).T
        polars = quick_bounds(self.as_blocks(every, values), self.lambda1, self.lambda2)
        polars += self.error(every, rounding(m + 2, np.float32) * size)
        # The sequences that the dual point was made for lie on the edge of the dual set: only exact products tell.
        doubtful = np.union1d(np.flatnonzero(polars > enough), self.columns // self.length)
        exact = self.rows[self.frames(doubtful)].astype(np.float64) @ self.theta.T
        sharp, lacking = self.examine(doubtful, exact, _THOROUGH, enough)
        polars[doubtful] = sharp + self.error(doubtful, self.rounding * size)
        self.evaluate(float(polars.max()))
        return lacking

    def error(self, blocks: Columns, share: float) -> Array:
        """Bound the polar of what rounding did to products: row r of G is off by at most ||x_r|| times a share."""
        radii = share * self.as_blocks(blocks, self.lengths[self.frames(blocks)][:, None])[:, :, 0]
        return bound_by_lengths(radii.max(axis=1), np.linalg.norm(radii, axis=1), self.lambda1, self.lambda2)

    def examine(self, blocks: Columns, values: Array, rounds: int, enough: float) -> tuple[Array, Columns]:
        """Bound the polars of some sequences; also return the frames that the worst violations lack.

        Parameters
        ----------
        blocks : intp array (b,)
            Template sequences, ascending.
        values : float64 array (r, q)
            X^T Theta of their frames.
        rounds : int
            Alternating projections.
        enough : float
            Bound that is no violation.
        """
        frames = self.frames(blocks)
        guess = values / (self.lambda1 + self.lambda2)
        if self.lambda1 > 0.0:
            # Where the columns are at the edge of their balls, rows without weight have to do without them.
            solved = np.isin(frames // self.length, self.columns // self.length)
            guess[solved] = values[solved] / self.lambda1
        _, here, there = np.intersect1d(frames, self.columns, assume_unique=True, return_indices=True)
        guess[here] = self.inner.U[there]
        shaped, lambdas = self.as_blocks(blocks, values), (self.lambda1, self.lambda2)
        bounds, V = polar_bounds(shaped, *lambdas, self.as_blocks(blocks, guess), rounds, enough)
        self.worst = max(self.worst, float(bounds.max(initial=1.0)))
        outside = np.flatnonzero(bounds > enough)
        most = max(_FIRST, np.unique(self.columns // self.length).size)
        outside = outside[np.argsort(-bounds[outside], kind="stable")[:most]]
        tight = np.linalg.norm(shaped - self.lambda2 * V, axis=2) >= _TIGHT * self.lambda1
        wanted = (blocks[outside, None] * self.length + np.arange(self.length))[tight[outside]]
        return bounds, np.setdiff1d(wanted[wanted < len(self.rows)], self.columns)

    def evaluate(self, largest_polar: float) -> None:
        """Find the objective and the lower bound; the best ones may be of different rounds."""
        weights = self.cleaned() * self.weight_scale
        # From inner products, 1e-8 of a query frame would be noise.
        norms = np.linalg.norm(self.query - self.combine(self.columns, weights), axis=1)
        reach = self.norms + self.lengths[self.columns] @ np.abs(weights)
        residuals = norms * (1.0 + self.rounding) + rounding(self.known.size + 2) * reach
        objective = float(residuals.sum()) + self.lambda1 * l21_norm(weights)
        objective += self.lambda2 * s1_norm(weights, self.length, self.columns)
        longest = float(np.linalg.norm(self.theta, axis=1).max()) * (1.0 + self.rounding)
        value = float(np.einsum("im,im->", self.theta, self.query))
        value -= self.rounding * float(np.linalg.norm(self.theta, axis=1) @ self.norms)
        bound = value / max(largest_polar, longest, 1.0)
        bound *= 1.0 - rounding(weights.size + self.length + residuals.size + _OPERATIONS)
        self.lower_bound = max(bound, self.lower_bound)
        if objective <= self.objective:
            self.objective, self.best_columns = objective, self.columns
            self.weights, self.residuals = weights, residuals

    def cleaned(self) -> Array:
        """W of the working set, without the rows and columns of blocks that have weight only by smoothing."""
        problem, weights = self.problem, self.inner.W
        ceiling = problem.objective(weights) * (1.0 + 0.2 * self.tolerance)
        rows = np.linalg.norm(weights, axis=1, keepdims=True)
        columns = np.sqrt(problem.sums(np.square(weights)))
        for share in (1e-2, 1e-3, 1e-4):
            kept = (rows > share * rows.max(initial=0.0)) & (columns > share * columns.max(initial=0.0))
            candidate = np.where(kept, weights, 0.0)
            if problem.objective(candidate) <= ceiling:
                return candidate
        return weights

    def grow(self, lacking: Columns) -> None:
        """Add frames, drop those without weight, and smooth as much as the violations ask for."""
        alive = np.linalg.norm(self.inner.U, axis=1) >= _ALIVE
        self.kept = np.union1d(self.kept, np.intersect1d(lacking, self.dropped))
        stay = self.columns[alive | np.isin(self.columns, self.kept)]
        self.dropped = np.union1d(self.dropped, np.setdiff1d(self.columns, stay))
        excess = (1.0 - 1.0 / self.worst) * self.problem.objective(self.inner.W)
        self.epsilon = min(max(self.problem.smoothing_for(excess), self.epsilon), FIRST_EPSILON)
        self.columns = np.union1d(stay, lacking)
