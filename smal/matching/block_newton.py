"""Solve Eq. 7 on few template frames: a primal-dual Newton method on smoothed norms.

Algorithm 2 of the paper divides by norms that become zero and converges linearly, slowly where frames of a
sequence resemble each other. We keep its idea (every norm is replaced by a quadratic) and change three things:

* each norm ||x|| is smoothed to sqrt(||x||^2 + epsilon^2), and epsilon falls as the duality gap falls;
* the subgradients U (rows) and V (columns of blocks) are variables of their own, linearised as in Chan,
  Golub & Mulet (1999), which makes Newton steps good far from the optimum too;
* the Newton system is solved by preconditioned conjugate gradients: applying it costs one product with X^T X,
  which all query frames share, where the paper's Eq. 12 inverts one matrix per query frame. We do that too where
  conjugate gradients stall, which is where residuals vanish or templates depend on each other linearly.

A stationary point of the smoothed problem satisfies X^T Theta = lambda1 U + lambda2 V with all of Theta, U, V
in their unit balls, which is a point of the dual problem: the certificate comes with the solution.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled
from smal.matching.block_problem import BlockProblem, Primal, dots, measure, smoothed, smoothed_objective, smoothing_for
from smal.matching.certificate import cheap_polar_bound, polar_bound
from smal.matching.newton_direction import System, newton_direction

Array = NDArray[np.float64]

#: Where smoothing starts without a better guess; lengths are near 1.
FIRST_EPSILON = 0.3
_LAST_EPSILON = 1e-9
_FASTEST = 0.2
_MAX_STEPS = 150
# A Newton direction need not be more accurate than this, since the next step corrects it, while the gap falls.
_INEXACT, _ACCURATE = 0.1, 1e-4
_ENOUGH_PROGRESS = 0.7
# Rounding must not make a Newton system indefinite; it changes the path, never the certificate.
_RIDGE = 1e-11
_ARMIJO = 1e-4
_SHORTEST_STEP = 1e-8
_TINY = 1e-300


@dataclass(frozen=True)
class BlockSolution:
    """W and the dual point that certifies it.

    Parameters
    ----------
    weights : float64 array (p, q)
        W.
    alpha : float64 array (q,)
        In the dual point Theta = Y diag(alpha) - X B, whose columns are in the unit ball.
    B : float64 array (p, q)
        In the dual point.
    U, V : float64 arrays (p, q)
        Subgradients of the norms of rows and of columns of blocks. U is the guess that lets
        `certificate.polar_bound` certify the sequences that were solved for.
    gap : float
        Relative duality gap of the restricted problem.
    epsilon : float
        How smooth the norms were at the end.
    steps : int
        Newton steps.
    """

    weights: Array
    alpha: Array
    B: Array
    U: Array
    V: Array
    gap: float
    epsilon: float
    steps: int


class _Dual(NamedTuple):
    """The subgradients: Theta by alpha and B (with X^T X B), U of rows, V of columns of blocks."""

    alpha: Array
    B: Array
    products: Array
    U: Array
    V: Array


@compiled
def _start_dual(problem: BlockProblem, primal: Primal, epsilon: float) -> _Dual:
    """Take the gradients of the smoothed norms."""
    d, e, f = smoothed(primal, epsilon)
    U, V = np.empty_like(primal.W), np.empty_like(primal.W)
    for j in range(problem.starts.size - 1):
        for r in range(problem.starts[j], problem.starts[j + 1]):
            U[r] = primal.W[r] / e[r]
            V[r] = primal.W[r] / f[j]
    return _Dual(1.0 / d, primal.W / d, primal.products / d, U, V)


@compiled
def _largest_polar(problem: BlockProblem, dual: _Dual) -> float:
    gradients = problem.correlations * dual.alpha - dual.products
    lambda1, lambda2 = problem.lambda1, problem.lambda2
    worst = 1.0
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        bound = cheap_polar_bound(gradients[start:end], lambda1, lambda2)
        if bound > worst:
            U, V = dual.U[start:end].copy(), np.empty_like(dual.U[start:end])
            bound = polar_bound(gradients[start:end], lambda1, lambda2, U, V, 2, worst)
        worst = max(worst, bound)
    return worst


@compiled
def _relative_gap(problem: BlockProblem, primal: Primal, dual: _Dual) -> float:
    value = (dual.alpha * problem.squares).sum() - dots(problem.correlations, dual.B).sum()
    gap: float = 1.0 - value / _largest_polar(problem, dual) / smoothed_objective(problem, primal, 0.0)
    return gap


@compiled
def _newton_system(problem: BlockProblem, primal: Primal, dual: _Dual, epsilon: float) -> tuple[System, Array]:
    """Linearise at W: the system and its right-hand side, minus the slope of the smoothed objective."""
    W = primal.W
    d, e, f = smoothed(primal, epsilon)
    gradients = problem.correlations - primal.products
    # <theta_i, r_i> / d_i, at most 1: how far the curvature of a residual norm is that of a cone.
    radial = dual.alpha * (problem.squares - dots(problem.correlations, W)) - dots(dual.B, gradients)
    residual_edges = gradients * np.sqrt(np.maximum(radial, 0.0) / primal.squared_residuals) / d
    diagonal, descent = np.empty_like(W), np.empty_like(W)
    row_edges, column_edges, preconditioner = np.empty_like(W), np.empty_like(W), np.empty_like(W)
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        along = np.maximum(dots(dual.V[start:end], W[start:end]), 0.0)
        column_scale = np.sqrt(problem.lambda2 * along / np.maximum(primal.squared_columns[j], _TINY)) / f[j]
        for r in range(start, end):
            row_scale = (
                np.sqrt(problem.lambda1 * max(np.dot(dual.U[r], W[r]), 0.0) / max(primal.squared_rows[r], _TINY)) / e[r]
            )
            for i in range(W.shape[1]):
                penalty = problem.lambda1 / e[r] + problem.lambda2 / f[j, i]
                descent[r, i] = gradients[r, i] / d[i] - penalty * W[r, i]
                row_edges[r, i], column_edges[r, i] = row_scale * W[r, i], column_scale[i] * W[r, i]
                diagonal[r, i] = _RIDGE / d[i] + penalty
                edges = residual_edges[r, i] ** 2 + row_edges[r, i] ** 2 + column_edges[r, i] ** 2
                curvature = problem.gram[r, r] / d[i] + diagonal[r, i]
                preconditioner[r, i] = 1.0 / max(curvature - edges, 1e-3 * diagonal[r, i])
    return System(d, diagonal, residual_edges, row_edges, column_edges, preconditioner), descent


@compiled
def _line_search(
    problem: BlockProblem, primal: Primal, direction: Array, products: Array, slope: float, epsilon: float
) -> tuple[Primal, float]:
    """Halve the step until the smoothed objective falls enough (Armijo)."""
    ceiling = smoothed_objective(problem, primal, epsilon) * (1.0 + 1e-14)
    step = 1.0
    while True:
        moved = measure(problem, primal.W + step * direction, primal.products + step * products)
        if smoothed_objective(problem, moved, epsilon) <= ceiling + _ARMIJO * step * slope or step < _SHORTEST_STEP:
            return moved, step
        step *= 0.5


@compiled
def _move_dual(
    problem: BlockProblem, primal: Primal, dual: _Dual, direction: Array, products: Array, epsilon: float
) -> _Dual:
    """Linearise the subgradients along the step and bring them back into their balls."""
    d, e, f = smoothed(primal, epsilon)
    moved = primal.W + direction
    # Theta + dTheta = (R + dR) / d - Theta <R, dR> / d^2, in terms of alpha and B.
    along = -dots(problem.correlations - primal.products, direction) / (d * d)
    alpha = 1.0 / d - dual.alpha * along
    B = moved / d - dual.B * along
    images = (primal.products + products) / d - dual.products * along
    squares = alpha * alpha * problem.squares + dots(B, images - 2.0 * alpha * problem.correlations)
    shrink = np.sqrt(np.maximum(squares, 1.0))
    U, V = np.empty_like(B), np.empty_like(B)
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        along = dots(primal.W[start:end], direction[start:end]) / (f[j] * f[j])
        V[start:end] = moved[start:end] / f[j] - dual.V[start:end] * along
        V[start:end] /= np.maximum(np.sqrt(dots(V[start:end], V[start:end])), 1.0)
        for r in range(start, end):
            U[r] = moved[r] / e[r] - dual.U[r] * (np.dot(primal.W[r], direction[r]) / (e[r] * e[r]))
            U[r] /= max(np.sqrt(np.dot(U[r], U[r])), 1.0)
    return _Dual(alpha / shrink, B / shrink, images / shrink, U, V)


@compiled
def _minimise(
    problem: BlockProblem, W: Array, alpha: Array, B: Array, U: Array, V: Array, epsilon: float, tolerance: float
) -> tuple[float, float, int]:
    """Minimise in place; the gap, the smoothing, the steps.

    W, U and V are the start, if U is not zero everywhere. Nothing but numbers is returned: making Python objects of
    arrays runs Python code, which an interrupt (Ctrl-C) would break off in the middle.
    """
    primal = measure(problem, W.copy(), np.dot(problem.gram, W))
    dual = _start_dual(problem, primal, epsilon)
    if np.any(U):
        dual = _Dual(dual.alpha, dual.B, dual.products, U.copy(), V.copy())
    gap, steps, accuracy = _relative_gap(problem, primal, dual), 0, _INEXACT
    best, best_primal, best_dual = gap, primal, dual
    while gap > tolerance and steps < _MAX_STEPS:
        system, descent = _newton_system(problem, primal, dual, epsilon)
        direction, products = newton_direction(problem, system, descent, accuracy)
        slope = -(descent * direction).sum()
        moved, step = _line_search(problem, primal, direction, products, slope, epsilon)
        dual = _move_dual(problem, primal, dual, step * direction, step * products, epsilon)
        primal = moved
        before, gap = gap, _relative_gap(problem, primal, dual)
        if gap < best:
            best, best_primal, best_dual = gap, primal, dual
        accuracy = _INEXACT if gap < _ENOUGH_PROGRESS * before else max(0.1 * accuracy, _ACCURATE)
        # A larger gap says that Newton's method has not yet caught up with epsilon.
        wanted = smoothing_for(problem, gap * smoothed_objective(problem, primal, 0.0))
        epsilon = max(min(max(wanted, _FASTEST * epsilon), epsilon), _LAST_EPSILON)
        steps += 1
    W[:], alpha[:], B[:] = best_primal.W, best_dual.alpha, best_dual.B
    U[:], V[:] = best_dual.U, best_dual.V
    return best, epsilon, steps


def solve_blocks(
    problem: BlockProblem,
    weights: Array,
    tolerance: float,
    epsilon: float = FIRST_EPSILON,
    subgradients: tuple[Array, Array] | None = None,
) -> BlockSolution:
    """Minimise Eq. 7 over the weights of a few template frames.

    Lengths are expected near 1 (`smal.matching.working_set` scales them), since epsilon is absolute.

    Parameters
    ----------
    problem : BlockProblem
    weights : float64 array (p, q)
        Where to start; zero is fine.
    tolerance : float
        Relative duality gap at which to stop.
    epsilon : float
        Smoothing to start with: less for a better start.
    subgradients : pair of float64 arrays (p, q), optional
        U and V to start with, in their balls; those of the smoothed norms if None.

    Returns
    -------
    BlockSolution
        The best that was reached; its gap tells whether that is within the tolerance.
    """
    W, alpha, B = weights.copy(), np.empty(weights.shape[1]), np.empty_like(weights)
    U, V = (np.zeros_like(weights), np.zeros_like(weights)) if subgradients is None else subgradients
    U, V = U.copy(), V.copy()
    gap, epsilon, steps = _minimise(problem, W, alpha, B, U, V, epsilon, tolerance)
    return BlockSolution(W, alpha, B, U, V, gap, epsilon, steps)
