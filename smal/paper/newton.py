"""Solve Eq. 7 on few template frames: a primal-dual Newton method on smoothed norms.

Algorithm 2 of the paper divides by norms that become zero, and converges linearly: slowly if the frames of a sequence
are similar. We keep its idea (every norm is replaced by a quadratic) and change two things:

* each norm ||x|| is smoothed to sqrt(||x||^2 + epsilon^2), and epsilon falls as the duality gap falls;
* the subgradients U (rows) and V (columns of blocks) are separate variables, linearised as in Chan,
  Golub & Mulet (1999), which makes Newton steps effective far from the optimum too.

A stationary point of the smoothed problem satisfies X^T Theta = lambda1 U + lambda2 V with all of Theta, U, V
in their unit balls, which is a point of the dual problem. So the solution includes its lower bound.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from smal.arrays import Floats, Indices
from smal.paper.duality_gap import polar_bounds
from smal.paper.objective import sequence_starts

FIRST_EPSILON = 0.3  # Initial smoothing without a better guess; lengths are near 1.
_LAST_EPSILON = 1e-9
_FASTEST = 0.2
_GAP_TO_EPSILON = 0.7
_MAX_STEPS = 150
# Keeps a Newton system definite under rounding; it changes the path, never the bound.
_RIDGE = 1e-11
_ARMIJO = 1e-4
_SHORTEST_STEP = 1e-8
# p^3 q from which on conjugate gradients are tried, and beyond which they are the only method.
_LARGE = 3e6
_TOO_LARGE = 1e9
_ACCURATE = 1e-2
_MOST_GRADIENTS = 150
_ROUNDING = 1e-15  # Squared residuals below this share of the query are rounding.
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class BlockProblem:
    """Eq. 7 restricted to p template frames, in terms of inner products.

    `gram` (p, p) is X^T X, `correlations` (p, q) X^T Y, and `squares` (q,) ||y_i||^2, all positive, near 1; `frames`
    (p,) are the template frames, ascending.
    """

    gram: Floats
    correlations: Floats
    squares: Floats
    lambda1: float
    lambda2: float
    frames: Indices
    sequence_length: int

    @cached_property
    def starts(self) -> Indices:
        """Rows at which another sequence begins, (b,)."""
        return sequence_starts(self.frames, self.sequence_length)

    @cached_property
    def block(self) -> Indices:
        """Number of the sequence of every row, among the b sequences, (p,)."""
        return np.repeat(np.arange(self.starts.size), np.diff(self.starts, append=self.frames.size))

    def sums(self, A: Floats) -> Floats:
        """Sum up the columns of blocks, each for all rows of its block (p, q)."""
        return np.add.reduceat(A, self.starts)[self.block] if len(A) else A

    def as_blocks(self, A: Floats) -> Floats:
        """Place rows (p, q) at their positions in their sequences, with zeros between them: (b, l, q)."""
        blocks = np.zeros((self.starts.size, self.sequence_length, A.shape[1]))
        blocks[self.block, self.frames % self.sequence_length] = A
        return blocks

    def slopes(self, W: Floats) -> Floats:
        """Return X^T R for the residuals R = Y - X W, (p, q)."""
        slopes: Floats = self.correlations - self.gram @ W
        return slopes

    def norms(self, W: Floats, epsilon: float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return the smoothed norms of residuals (q,), rows (p, 1) and columns of blocks (p, q)."""
        residuals = self.squares - (W * (self.correlations + self.slopes(W))).sum(axis=0)
        square = epsilon * epsilon
        d = np.sqrt(np.maximum(residuals, _ROUNDING * self.squares) + square)
        return d, np.sqrt(_rows(W * W) + square), np.sqrt(self.sums(W * W) + square)

    def objective(self, W: Floats, epsilon: float = 0.0) -> float:
        """Return the smoothed Eq. 7 at W (p, q)."""
        d, e, f = self.norms(W, epsilon)
        return float(d.sum() + self.lambda1 * e.sum() + self.lambda2 * f[self.starts].sum())

    def smoothing_for(self, excess: float) -> float:
        """Return the epsilon that costs about as much as the excess of the objective: 0.3 epsilon a norm, doubled."""
        p, q = self.correlations.shape
        norms = q + self.lambda1 * p + self.lambda2 * q * self.starts.size
        return float(_GAP_TO_EPSILON * excess / norms)


class Iterate(NamedTuple):
    """W, the dual point Theta = Y diag(alpha) - X B, subgradients U of rows, V of columns: (p, q); alpha (q,)."""

    W: Floats
    alpha: Floats
    B: Floats
    U: Floats
    V: Floats

    def gap(self, problem: BlockProblem) -> float:
        """Return the relative duality gap of the restricted problem."""
        gradients = problem.as_blocks(problem.correlations * self.alpha - problem.gram @ self.B)
        lambdas = (problem.lambda1, problem.lambda2)
        guess = problem.as_blocks(self.U)
        largest = polar_bounds(gradients, *lambdas, guess, rounds=2, enough=1.0)[0].max(initial=1.0)
        value = (self.alpha * problem.squares).sum() - (problem.correlations * self.B).sum()
        return float(1.0 - value / largest / problem.objective(self.W))


def minimize(
    problem: BlockProblem, W: Floats, U: Floats, V: Floats, epsilon: float, tolerance: float
) -> tuple[Iterate, float, int]:
    """Minimize Eq. 7 over the weights of a few template frames, to a relative duality gap.

    The start is W, U and V (p, q); if U is zero, the subgradients are those of the smoothed norms. A better start needs
    less smoothing. Returns the best iterate, the final smoothing, and the number of Newton steps.
    """
    d, e, f = problem.norms(W, epsilon)
    now = Iterate(W, 1.0 / d, W / d, *((U, V) if U.any() else (W / e, W / f)))
    gap = now.gap(problem)
    steps = 0
    best = now
    best_gap = gap
    while gap > tolerance and steps < _MAX_STEPS:
        now = _newton_step(problem, now, epsilon)
        steps = steps + 1
        gap = now.gap(problem)
        if gap < best_gap:
            best = now
            best_gap = gap
        # A growing gap means that Newton's method has not yet converged for this epsilon.
        wanted = problem.smoothing_for(gap * problem.objective(now.W))
        epsilon = max(min(max(wanted, _FASTEST * epsilon), epsilon), _LAST_EPSILON)
    return best, epsilon, steps


def _newton_step(problem: BlockProblem, now: Iterate, epsilon: float) -> Iterate:
    """Linearise at W, solve, and move W, the dual point and the subgradients."""
    W, alpha, B, U, V = now
    norms = d, e, f = problem.norms(W, epsilon)
    slopes = problem.slopes(W)
    penalty = problem.lambda1 / e + problem.lambda2 / f
    descent = slopes / d - penalty * W
    # <theta_i, r_i> / d_i, at most 1: the share of a cone in the curvature of a residual norm.
    fit = problem.squares - (problem.correlations * W).sum(axis=0)
    radial = alpha * fit - (B * slopes).sum(axis=0)
    squares = np.maximum(d * d - epsilon * epsilon, _ROUNDING * problem.squares)
    along_rows = np.maximum(_rows(U * W), 0.0)
    along_columns = np.maximum(problem.sums(V * W), 0.0)
    system = _System(
        problem,
        d,
        _RIDGE / d + penalty,
        slopes * np.sqrt(np.maximum(radial, 0.0) / squares) / d,
        W * np.sqrt(problem.lambda1 * along_rows / np.maximum(_rows(W * W), _TINY)) / e,
        W * np.sqrt(problem.lambda2 * along_columns / np.maximum(problem.sums(W * W), _TINY)) / f,
    )
    direction = system.solve(descent)
    # Halve the step until the smoothed objective falls enough (Armijo).
    fall = float((descent * direction).sum())
    share = 1.0
    ceiling = problem.objective(W, epsilon) * (1.0 + 1e-14)
    while share >= _SHORTEST_STEP:
        if problem.objective(W + share * direction, epsilon) <= ceiling - _ARMIJO * share * fall:
            break
        share *= 0.5
    return _moved(problem, now, share * direction, *norms)


def _moved(
    problem: BlockProblem, now: Iterate, step: Floats, d: Floats, e: Floats, f: Floats
) -> Iterate:
    """Linearise the subgradients along the step, and project them onto their balls."""
    W, alpha, B, U, V = now
    moved = W + step
    # Theta + dTheta = (R + dR) / d - Theta <R, dR> / d^2, in terms of alpha and B.
    along = -(problem.slopes(W) * step).sum(axis=0) / (d * d)
    alpha = 1.0 / d - alpha * along
    B = moved / d - B * along
    inner = problem.gram @ B - 2.0 * alpha * problem.correlations
    squares = alpha * alpha * problem.squares + (B * inner).sum(axis=0)
    shrink = np.sqrt(np.maximum(squares, 1.0))
    U = moved / e - U * _rows(W * step) / (e * e)
    V = moved / f - V * problem.sums(W * step) / (f * f)
    U = U / np.sqrt(np.maximum(_rows(U * U), 1.0))
    V = V / np.sqrt(np.maximum(problem.sums(V * V), 1.0))
    return Iterate(moved, alpha / shrink, B / shrink, U, V)


class _System(NamedTuple):
    """A Newton system: X^T X / d + diagonal less the rank-one terms of residuals, rows and columns of blocks."""

    problem: BlockProblem
    d: Floats
    diagonal: Floats
    of_residuals: Floats
    of_rows: Floats
    of_columns: Floats

    def solve(self, descent: Floats) -> Floats:
        """Return the direction (p, q): exact, or by conjugate gradients for a large system."""
        size = len(descent) ** 3 * descent.shape[1]
        if size > _LARGE:
            direction, accurate = self.by_conjugate_gradients(descent)
            if accurate or size > _TOO_LARGE:
                return direction
        return self.by_inversion(descent)

    def by_inversion(self, descent: Floats) -> Floats:
        """Invert a matrix for each query frame; only the terms of rows, - Z Z^T, couple them (Woodbury)."""
        problem = self.problem
        of_rows = self.of_rows
        matrices = problem.gram / self.d[:, None, None] - _outer(self.of_residuals)
        matrices -= _outer(self.of_columns) * (problem.block[:, None] == problem.block)
        rows = np.arange(len(descent))
        matrices[:, rows, rows] += self.diagonal.T
        inverses = np.linalg.inv(matrices)
        direction = np.einsum("irs,si->ri", inverses, descent)
        coupling = np.eye(len(descent)) - np.einsum("irs,ri,si->rs", inverses, of_rows, of_rows)
        shared = np.linalg.solve(coupling, (of_rows * direction).sum(axis=1))
        found: Floats = direction + np.einsum("irs,si->ri", inverses, of_rows * shared[:, None])
        return found

    def by_conjugate_gradients(self, descent: Floats) -> tuple[Floats, bool]:
        """Return the direction, and whether it is accurate."""
        edges = self.of_residuals**2 + self.of_rows**2 + self.of_columns**2
        curvature = self.problem.gram.diagonal()[:, None] / self.d + self.diagonal
        scale = 1.0 / np.maximum(curvature - edges, 1e-3 * self.diagonal).ravel()
        shape = descent.shape
        sides = (descent.size,) * 2
        system = LinearOperator(
            sides, lambda v: self.times(v.reshape(shape)).ravel(), dtype=np.float64
        )
        preconditioner = LinearOperator(sides, lambda v: v.ravel() * scale, dtype=np.float64)
        found, failed = cg(
            system, descent.ravel(), rtol=_ACCURATE, maxiter=_MOST_GRADIENTS, M=preconditioner
        )
        return found.reshape(shape), failed == 0

    def times(self, D: Floats) -> Floats:
        """Multiply with D (p, q)."""
        product: Floats = self.problem.gram @ D / self.d + self.diagonal * D
        product -= self.of_residuals * (self.of_residuals * D).sum(axis=0)
        by_columns = self.of_columns * self.problem.sums(self.of_columns * D)
        product -= self.of_rows * _rows(self.of_rows * D) + by_columns
        return product


def _rows(A: Floats) -> Floats:
    """Return the sum of every row (p, 1)."""
    sums: Floats = A.sum(axis=1, keepdims=True)
    return sums


def _outer(A: Floats) -> Floats:
    """Return the outer product of every column of (p, q) with itself, (q, p, p)."""
    product: Floats = A.T[:, :, None] * A.T[:, None, :]
    return product
