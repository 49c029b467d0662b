"""A working set of template frames for Eq. 7, grown until the duality gap of the full problem is small.

1. Solve Eq. 7 on the working set alone (`newton`), which gives a point Theta of the dual problem as well.
2. Bound the polars of all template sequences at Theta (`duality_gap`).
3. Stop if the gap is within the tolerance; otherwise add the frames of the sequences whose polar exceeds 1.

One product of all templates with Theta in float32, with a bound on its rounding, excludes nearly all sequences. The
others are multiplied in float64. So no bound is too low.
"""

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Indices
from smal.paper.duality_gap import bound_by_lengths, polar_bounds, quick_bounds, rounding
from smal.paper.newton import FIRST_EPSILON, BlockProblem, minimize
from smal.paper.objective import l21_norm, s1_norm

_FIRST = 4  # Number of initial sequences.
_MAX_ROUNDS = 200
# Projections to bound polars: while sequences are being selected, and for the proof.
_QUICK = 8
_THOROUGH = 100
_TIGHT = 0.7  # A row can have a weight if the dual point reaches this share of its limit.
_LOOSE = 1e-2  # Gap of Eq. 7 while the likely sequences are being selected.
_OPERATIONS = 32  # Operations of the objective and its quotient with the bound, beside the terms of their sums.


class WorkingSet:
    """The working set, the best solution on it, and the best lower bound on the optimum of the full problem.

    `rows` (n, m) are template frames in float32, `query` (q, m) nonzero query frames, `length` is l.

    Attributes
    ----------
    columns, weights, residuals
        Template frames of the best solution (p,), their weights (p, q), and ||y_i - X w_i|| (q,), rounded up.
    objective, lower_bound
        Objective of the best solution, and the lower bound.
    steps
        Total number of Newton steps.
    """

    def __init__(
        self,
        rows: Float32s,
        query: Floats,
        length: int,
        lambda1: float,
        lambda2: float,
        tolerance: float,
    ) -> None:
        self._rows = rows
        self._query = query
        self._length = length
        self._tolerance = tolerance
        self._lambdas = lambda1, lambda2
        n, m = rows.shape
        q = len(query)
        # Bound of the relative error of float64 products, and of their sums.
        self._rounding = rounding(m + q + 2)
        #: ||y_i||, rounded up.
        self._norms: Floats = np.linalg.norm(query, axis=1) * (1.0 + self._rounding)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.einsum("rm,rm->r", rows, rows)
            unit_query = (query / self._norms[:, None]).astype(np.float32)
            alike = np.square(rows @ unit_query.T).sum(axis=1)
        # NaN or infinity in X shows in these.
        if not np.isfinite(squares).all():
            raise ValueError("templates contain NaN or infinity, or overflow float32 products")
        underflow = m * float(np.finfo(np.float32).tiny)
        #: ||x_r||, rounded up.
        relative = 1.0 + rounding(m, np.float32)
        self._lengths: Floats = np.sqrt(squares.astype(np.float64) * relative + underflow)

        likely = np.argsort(-np.add.reduceat(alike, np.arange(0, n, length)), kind="stable")
        self._set = self._frames(np.sort(likely[:_FIRST]))
        nothing = np.zeros(0, dtype=np.intp)
        #: The last working set, and W, U and V on it, to start from.
        self._before = nothing
        self._start = np.zeros((3, 0, q))
        self._epsilon = FIRST_EPSILON
        self.columns = nothing
        self.weights = np.zeros((0, q))
        self.residuals = self._norms
        self.objective = float(self._norms.sum())
        self.lower_bound = 0.0
        self.steps = 0

    @property
    def gap(self) -> float:
        """Relative duality gap of the full problem."""
        return 1.0 - self.lower_bound / self.objective

    def grow_until_proved(self) -> None:
        """Grow the working set until the gap of the full problem is within the tolerance, or rounding stops it."""
        finest = 0.3 * self._tolerance
        tolerance = max(_LOOSE, finest)
        for _ in range(_MAX_ROUNDS):
            self._solve(tolerance)
            lacking = self._prove(tolerance)
            if self.gap <= self._tolerance:
                return
            if not lacking.size:
                # No frame is missing: solve the restricted problem more exactly, down to a limit.
                if tolerance < 1e-3 * self._tolerance:
                    return
                tolerance = finest if tolerance > finest else 0.3 * tolerance
            # Add frames, and smooth according to the violations.
            excess = (1.0 - 1.0 / self._worst) * self._problem.objective(self._inner.W)
            epsilon = max(self._problem.smoothing_for(excess), self._epsilon)
            self._epsilon = min(epsilon, FIRST_EPSILON)
            self._set = np.union1d(self._set, lacking)

    def _frames(self, blocks: Indices) -> Indices:
        """Return the template frames of sequences."""
        every = (blocks[:, None] * self._length + np.arange(self._length)).ravel()
        existing: Indices = every[every < len(self._rows)]
        return existing

    def _as_blocks(self, blocks: Indices, values: AnyArray) -> AnyArray:
        """Reshape values of the frames of sequences (r, q) to (b, l, q); the last sequence can be shorter."""
        missing = blocks.size * self._length - len(values)
        padded = np.pad(values, ((0, missing), (0, 0))) if missing else values
        return padded.reshape(blocks.size, self._length, values.shape[1])

    def _solve(self, tolerance: float) -> None:
        """Solve Eq. 7 on the working set, with lengths scaled to 1."""
        #: The frames of the working set (p, m), in float64.
        self._frames_of_set = self._rows[self._set].astype(np.float64)
        gram = self._frames_of_set @ self._frames_of_set.T
        correlations = self._frames_of_set @ self._query.T
        template_scale = float(np.sqrt(gram.diagonal().max(initial=0.0))) or 1.0
        query_scale = float(self._norms.max())
        self._weight_scale = query_scale / template_scale
        self._problem = BlockProblem(
            gram / template_scale**2,
            correlations / (template_scale * query_scale),
            (self._norms / query_scale) ** 2,
            self._lambdas[0] / template_scale,
            self._lambdas[1] / template_scale,
            self._set,
            self._length,
        )
        _, here, there = np.intersect1d(
            self._set, self._before, assume_unique=True, return_indices=True
        )
        start = np.zeros((3, *correlations.shape))
        start[:, here] = self._start[:, there]
        start[0] /= self._weight_scale
        W, U, V = start
        self._inner, self._epsilon, steps = minimize(
            self._problem, W, U, V, self._epsilon, tolerance
        )
        W, alpha, B, U, V = self._inner
        self._before = self._set
        self._start = np.stack([W * self._weight_scale, U, V])
        self.steps += steps
        self._worst = 1.0
        #: The dual point, a row a query frame (q, m).
        self._theta: Floats = (alpha / query_scale)[:, None] * self._query
        self._theta -= (B / template_scale).T @ self._frames_of_set

    def _prove(self, tolerance: float) -> Indices:
        """Bound all polars, and with them the optimum from below; return the missing frames."""
        n, m = self._rows.shape
        size = float(np.linalg.norm(self._theta))
        # Polars up to `enough` need no attention.
        loose = tolerance > 0.3 * self._tolerance
        enough = 1.0 + (tolerance if loose else 0.25 * self._tolerance)
        every = np.arange(-(-n // self._length))
        values = self._rows @ self._theta.astype(np.float32).T
        polars = quick_bounds(self._as_blocks(every, values), *self._lambdas)
        polars += self._error(every, rounding(m + 2, np.float32) * size)
        # The sequences of the working set lie on the edge of the dual set: they need exact products.
        doubtful = np.union1d(np.flatnonzero(polars > enough), self._set // self._length)
        exact = self._rows[self._frames(doubtful)].astype(np.float64) @ self._theta.T
        sharp, lacking = self._examine(doubtful, exact, _QUICK if loose else _THOROUGH, enough)
        polars[doubtful] = sharp + self._error(doubtful, self._rounding * size)
        self._evaluate(float(polars.max()))
        return lacking

    def _error(self, blocks: Indices, share: float) -> Floats:
        """Bound the polar of rounding errors of products: row r of G is off by at most ||x_r|| times a share."""
        lengths = self._lengths[self._frames(blocks)][:, None]
        radii = share * self._as_blocks(blocks, lengths)[:, :, 0]
        longest_row = radii.max(axis=1, initial=0.0)
        longest_column = np.linalg.norm(radii, axis=1)
        return bound_by_lengths(longest_row, longest_column, *self._lambdas)

    def _examine(
        self, blocks: Indices, values: Floats, rounds: int, enough: float
    ) -> tuple[Floats, Indices]:
        """Bound polars by X^T Theta of frames (r, q); also return missing frames of the worst bounds above `enough`."""
        lambda1, lambda2 = self._lambdas
        frames = self._frames(blocks)
        guess = values / (lambda1 + lambda2)
        if lambda1 > 0.0:
            # If the columns are at the edge of their balls, rows without weight get no share of them.
            solved = np.isin(frames // self._length, self._set // self._length)
            guess[solved] = values[solved] / lambda1
        _, here, there = np.intersect1d(frames, self._set, assume_unique=True, return_indices=True)
        guess[here] = self._inner.U[there]
        shaped = self._as_blocks(blocks, values)
        start = self._as_blocks(blocks, guess)
        bounds, V = polar_bounds(shaped, lambda1, lambda2, start, rounds, enough)
        self._worst = max(self._worst, float(bounds.max(initial=1.0)))
        outside = np.flatnonzero(bounds > enough)
        most = max(_FIRST, np.unique(self._set // self._length).size)
        outside = outside[np.argsort(-bounds[outside], kind="stable")[:most]]
        tight = np.linalg.norm(shaped - lambda2 * V, axis=2) >= _TIGHT * lambda1
        wanted = (blocks[outside, None] * self._length + np.arange(self._length))[tight[outside]]
        return bounds, np.setdiff1d(wanted[wanted < len(self._rows)], self._set)

    def _evaluate(self, largest_polar: float) -> None:
        """Compute the objective and the lower bound; the best of each can come from different rounds."""
        weights = self._cleaned() * self._weight_scale
        # Inner products have an error of 1e-8 of a query frame.
        norms = np.linalg.norm(self._query - weights.T @ self._frames_of_set, axis=1)
        reach = self._norms + self._lengths[self._set] @ np.abs(weights)
        residuals = norms * (1.0 + self._rounding) + rounding(self._set.size + 2) * reach
        rows_penalty = self._lambdas[0] * l21_norm(weights)
        blocks_penalty = self._lambdas[1] * s1_norm(weights, self._length, self._set)
        objective = float(residuals.sum()) + (rows_penalty + blocks_penalty)
        columns = np.linalg.norm(self._theta, axis=1)
        error = self._rounding * float(columns @ self._norms)
        value = float(np.einsum("im,im->", self._theta, self._query)) - error
        longest = float(columns.max()) * (1.0 + self._rounding)
        bound = value / max(largest_polar, longest, 1.0)
        bound *= 1.0 - rounding(weights.size + self._length + residuals.size + _OPERATIONS)
        self.lower_bound = max(bound, self.lower_bound)
        if objective <= self.objective:
            self.objective = objective
            self.columns = self._set
            self.weights = weights
            self.residuals = residuals

    def _cleaned(self) -> Floats:
        """Return W of the working set, without rows and columns of blocks that have weight only by smoothing."""
        problem = self._problem
        weights = self._inner.W
        ceiling = problem.objective(weights) * (1.0 + 0.2 * self._tolerance)
        rows = np.linalg.norm(weights, axis=1, keepdims=True)
        columns = np.sqrt(problem.sums(np.square(weights)))
        for share in (1e-2, 1e-3, 1e-4):
            heavy_rows = rows > share * rows.max(initial=0.0)
            heavy_columns = columns > share * columns.max(initial=0.0)
            kept = heavy_rows & heavy_columns
            candidate = np.where(kept, weights, 0.0)
            if problem.objective(candidate) <= ceiling:
                return candidate
        return weights
