"""Solve Eq. 7 on a few template sequences: a primal-dual Newton method on smoothed norms.

Algorithm 2 of the paper divides by norms that become zero and converges linearly, slowly where frames of a
sequence resemble each other. We keep its idea (every norm is replaced by a quadratic) and change three things:

* each norm ||x|| is smoothed to sqrt(||x||^2 + epsilon^2), and epsilon falls as the duality gap falls;
* the subgradients U (rows) and V (columns of blocks) are variables of their own, linearised as in Chan,
  Golub & Mulet (1999), which makes Newton steps good far from the optimum too;
* the Newton system is l systems of size p (one per query frame, the paper's Eq. 9 matrices) coupled by
  one rank-one term per row, so the Woodbury identity solves it at the price of l inversions.

A stationary point of the smoothed problem satisfies X^T Theta = lambda1 U + lambda2 V with all of Theta, U, V
in their unit balls, which is a point of the dual problem: the certificate comes with the solution.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smal.certificate import polar_bounds

Array = NDArray[np.float64]

_FIRST_EPSILON, _LAST_EPSILON = 0.3, 1e-9

_GAP_TO_EPSILON = 0.7
_MAX_STEPS = 150
# Rounding must not make a Newton system indefinite; it changes the path, never the certificate.
_RIDGE = 1e-11
# Squared residuals below this share of the query are rounding.
_ROUNDING = 1e-15
_ARMIJO = 1e-4
_SHORTEST_STEP = 1e-8
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class BlockProblem:
    """Eq. 7 restricted to b template sequences, in terms of inner products.

    Parameters
    ----------
    gram : float64 array (p, p)
        X^T X with p = b * l rows; the rows that fill up a short last sequence are zero.
    correlations : float64 array (p, q)
        X^T Y.
    squares : float64 array (q,)
        ||y_i||^2, all positive.
    lambda1, lambda2 : float
    sequence_length : int
    """

    gram: Array
    correlations: Array
    squares: Array
    lambda1: float
    lambda2: float
    sequence_length: int

    def residual_squares(self, weights: Array, products: Array) -> Array:
        """||y_i - X w_i||^2 with `products` = gram @ weights."""
        squares = self.squares - np.einsum("pi,pi->i", weights, 2.0 * self.correlations - products)
        floored: Array = np.maximum(squares, _ROUNDING * self.squares)
        return floored

    def residual_norms(self, weights: Array) -> Array:
        """||y_i - X w_i|| of every query frame."""
        norms: Array = np.sqrt(self.residual_squares(weights, self.gram @ weights))
        return norms

    def blocks(self, weights: Array) -> Array:
        """View (p, q) as (b, l, q)."""
        return weights.reshape(-1, self.sequence_length, weights.shape[1])

    def objective(self, weights: Array, epsilon: float = 0.0) -> float:
        """Eq. 7, every norm smoothed by epsilon."""
        epsilon2 = epsilon * epsilon
        residuals = np.sqrt(self.residual_squares(weights, self.gram @ weights) + epsilon2)
        squares = weights * weights
        rows = np.sqrt(squares.sum(axis=1) + epsilon2).sum()
        columns = np.sqrt(self.blocks(squares).sum(axis=1) + epsilon2).sum()
        return float(residuals.sum() + self.lambda1 * rows + self.lambda2 * columns)


@dataclass(frozen=True)
class BlockSolution:
    """W and the dual point that certifies it.

    Parameters
    ----------
    weights : float64 array (p, q)
        W.
    query_shares : float64 array (q,)
        alpha in the dual point Theta = Y diag(alpha) - X B, whose columns are in the unit ball.
    dual_weights : float64 array (p, q)
        B in the dual point.
    rows : float64 array (p, q)
        U, the guess that lets `polar_bounds` certify the blocks that were solved for.
    gap : float
        Relative duality gap of the restricted problem.
    steps : int
        Newton steps.
    """

    weights: Array
    query_shares: Array
    dual_weights: Array
    rows: Array
    gap: float
    steps: int


def _columnwise(start: Array, left: Array, right: Array) -> Array:
    """start_i + <left_i, right_i> for every column i."""
    sums: Array = start + np.einsum("pi,pi->i", left, right)
    return sums


class _Iterate:
    """W, the subgradients Theta, U and V, and every norm that a Newton step needs, at one epsilon."""

    def __init__(self, problem: BlockProblem, weights: Array, epsilon: float) -> None:
        self.problem = problem
        self.weights = weights
        self._measure()
        self.smooth(epsilon)
        self.query_shares = 1.0 / self.d
        self.dual_weights = weights / self.d
        self.rows = weights / self.e[:, None]
        self.columns = problem.blocks(weights) / self.f[:, None, :]

    def _measure(self) -> None:
        problem, W = self.problem, self.weights
        products = problem.gram @ W
        self.gradient = problem.correlations - products  # X^T (Y - X W)
        self.residual_squares = problem.residual_squares(W, products)
        squares = W * W
        self.row_squares = squares.sum(axis=1)
        self.column_squares = problem.blocks(squares).sum(axis=1)

    def smooth(self, epsilon: float) -> None:
        """Set the smoothed norms: d of residuals, e of rows, f of columns of blocks."""
        self.epsilon = epsilon
        epsilon2 = epsilon * epsilon
        self.d = np.sqrt(self.residual_squares + epsilon2)
        self.e = np.sqrt(self.row_squares + epsilon2)
        self.f = np.sqrt(self.column_squares + epsilon2)

    def gap(self) -> tuple[float, float]:
        """Relative duality gap of the restricted problem, and the objective."""
        problem = self.problem
        primal = (
            np.sqrt(self.residual_squares).sum()
            + problem.lambda1 * np.sqrt(self.row_squares).sum()
            + problem.lambda2 * np.sqrt(self.column_squares).sum()
        )
        gradients = problem.correlations * self.query_shares - problem.gram @ self.dual_weights
        rows = problem.blocks(self.rows)
        polar = polar_bounds(problem.blocks(gradients), problem.lambda1, problem.lambda2, rows, rounds=2).max()
        dual = _columnwise(self.query_shares * problem.squares, problem.correlations, -self.dual_weights).sum()
        return float(1.0 - dual / max(1.0, float(polar)) / primal), float(primal)

    def move(self, direction: Array) -> None:
        """Take a step, with the subgradients linearised along it and brought back into their balls."""
        blocks = self.problem.blocks
        W, step = self.weights, direction
        self._move_dual(step)
        along = np.einsum("pi,pi->p", W, step) / self.e**2
        self.rows = (W + step) / self.e[:, None] - self.rows * along[:, None]
        self.rows /= np.maximum(np.linalg.norm(self.rows, axis=1, keepdims=True), 1.0)
        along = np.einsum("bri,bri->bi", blocks(W), blocks(step)) / self.f**2
        self.columns = blocks(W + step) / self.f[:, None, :] - self.columns * along[:, None, :]
        self.columns /= np.maximum(np.sqrt(np.square(self.columns).sum(axis=1, keepdims=True)), 1.0)
        self.weights = W + step
        self._measure()

    def _move_dual(self, step: Array) -> None:
        """Theta + dTheta = (R + dR) / d - Theta <R, dR> / d^2, in terms of alpha and B."""
        problem = self.problem
        along = -np.einsum("pi,pi->i", self.gradient, step) / self.d**2
        alpha = 1.0 / self.d - self.query_shares * along
        B = (self.weights + step) / self.d - self.dual_weights * along
        squares = alpha * alpha * problem.squares
        squares = _columnwise(squares, B, problem.gram @ B - 2.0 * alpha * problem.correlations)
        shrink = np.sqrt(np.maximum(squares, 1.0))
        self.query_shares, self.dual_weights = alpha / shrink, B / shrink

    def residual_share(self) -> Array:
        """<theta_i, r_i> / d_i, at most 1: how far the curvature of a residual norm is that of a cone."""
        problem = self.problem
        start = self.query_shares * _columnwise(problem.squares, problem.correlations, -self.weights)
        return np.maximum(_columnwise(start, self.dual_weights, -self.gradient), 0.0) / self.d


def _newton_direction(at: _Iterate, slope: Array) -> Array:
    """Solve the Newton system H D = -slope; H is positive definite.

    H is block diagonal with the blocks A_i (one per query frame) minus Z Z^T, one column of Z per row of W.
    """
    problem = at.problem
    p, q = slope.shape
    l = problem.sequence_length  # noqa: E741
    radial_rows = np.maximum(np.einsum("pi,pi->p", at.rows, at.weights), 0.0) / at.e
    Z = at.weights * np.sqrt(problem.lambda1 * radial_rows / at.e / np.maximum(at.row_squares, _TINY))[:, None]
    blocks = problem.blocks(at.weights)
    radial_columns = np.maximum(np.einsum("bri,bri->bi", at.columns, blocks), 0.0) / at.f
    scale = np.sqrt(problem.lambda2 * radial_columns / at.f / np.maximum(at.column_squares, _TINY))
    inner = blocks * scale[:, None, :]

    g = (at.gradient * np.sqrt(at.residual_share() / at.d / at.residual_squares)).T
    A = problem.gram / at.d[:, None, None] - g[:, :, None] * g[:, None, :]
    diagonal = np.arange(p)
    A[:, diagonal, diagonal] += (
        _RIDGE / at.d[:, None] + problem.lambda1 / at.e + problem.lambda2 * np.repeat(1.0 / at.f, l, axis=0).T
    )
    block = np.arange(p // l)
    A.reshape(q, p // l, l, p // l, l)[:, block, :, block, :] -= np.einsum("bri,bsi->birs", inner, inner)

    inverse = np.linalg.inv(A)
    coupling = np.eye(p) - np.einsum("ri,irs,si->rs", Z, inverse, Z)
    plain = np.einsum("irs,si->ri", inverse, slope)
    shared = np.linalg.solve(coupling, np.einsum("pi,pi->p", Z, plain))
    direction: Array = -(plain + np.einsum("irs,si->ri", inverse, Z * shared[:, None]))
    return direction


def _line_search(at: _Iterate, slope: Array, direction: Array) -> float:
    """Halve the step until the smoothed objective falls enough (Armijo)."""
    problem = at.problem
    start = problem.objective(at.weights, at.epsilon)
    descent = float(np.einsum("pi,pi->", slope, direction))
    step = 1.0
    while problem.objective(at.weights + step * direction, at.epsilon) > start * (1 + 1e-14) + _ARMIJO * step * descent:
        step *= 0.5
        if step < _SHORTEST_STEP:
            break
    return step


def solve_blocks(problem: BlockProblem, weights: Array, tolerance: float) -> BlockSolution:
    """Minimise Eq. 7 over the weights of a few template sequences.

    Lengths are expected near 1 (`smal.state_matching` scales them), since epsilon is absolute.

    Parameters
    ----------
    problem : BlockProblem
    weights : float64 array (p, q)
        Where to start; zero is fine.
    tolerance : float
        Relative duality gap at which to stop.

    Returns
    -------
    BlockSolution
        The best that was reached; its gap tells whether that is within the tolerance.
    """
    # Smoothing alone costs a gap of about 0.3 epsilon per norm.
    p, q = weights.shape
    norms = q + problem.lambda1 * p + problem.lambda2 * q * (p // problem.sequence_length)
    epsilon, steps = _FIRST_EPSILON, 0
    at = _Iterate(problem, weights, epsilon)
    gap, primal = at.gap()
    while gap > tolerance and steps < _MAX_STEPS:
        slope = problem.lambda1 * at.weights / at.e[:, None] - at.gradient / at.d
        slope += problem.lambda2 * (problem.blocks(at.weights) / at.f[:, None, :]).reshape(slope.shape)
        direction = _newton_direction(at, slope)
        at.move(_line_search(at, slope, direction) * direction)
        gap, primal = at.gap()
        # A larger gap says that Newton's method has not yet caught up with epsilon.
        epsilon = max(float(np.clip(_GAP_TO_EPSILON * gap * primal / norms, 0.2 * epsilon, epsilon)), _LAST_EPSILON)
        at.smooth(epsilon)
        steps += 1
    return BlockSolution(at.weights, at.query_shares, at.dual_weights, at.rows, gap, steps)
