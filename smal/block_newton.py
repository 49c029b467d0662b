"""Solve Eq. 7 on few template frames: a primal-dual Newton method on smoothed norms.

Algorithm 2 of the paper divides by norms that become zero and converges linearly, slowly where frames of a
sequence resemble each other. We keep its idea (every norm is replaced by a quadratic) and change three things:

* each norm ||x|| is smoothed to sqrt(||x||^2 + epsilon^2), and epsilon falls as the duality gap falls;
* the subgradients U (rows) and V (columns of blocks) are variables of their own, linearised as in Chan,
  Golub & Mulet (1999), which makes Newton steps good far from the optimum too;
* the Newton system is solved by preconditioned conjugate gradients: applying it costs one product with X^T X,
  which all query frames share, where the paper's Eq. 9 inverts one matrix per query frame. We do that too where
  conjugate gradients stall, which is where residuals vanish or templates depend on each other linearly.

A stationary point of the smoothed problem satisfies X^T Theta = lambda1 U + lambda2 V with all of Theta, U, V
in their unit balls, which is a point of the dual problem: the certificate comes with the solution.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.certificate import cheap_polar_bound, polar_bound
from smal.compiled import compiled

Array = NDArray[np.float64]

#: Where smoothing starts without a better guess; lengths are near 1.
FIRST_EPSILON = 0.3
_LAST_EPSILON = 1e-9
_GAP_TO_EPSILON = 0.7
_FASTEST = 0.2
_MAX_STEPS = 150
# A Newton direction need not be more accurate than this, since the next step corrects it, while the gap falls.
_INEXACT, _ACCURATE = 0.1, 1e-4
_ENOUGH_PROGRESS = 0.7
# Conjugate gradients beyond so many steps cost more than inversions do, unless p^3 q is larger than this.
_MAX_CONJUGATE = 150
_LARGEST_INVERSION = 1e9
# Rounding must not make a Newton system indefinite; it changes the path, never the certificate.
_RIDGE = 1e-11
# Squared residuals below this share of the query are rounding.
_ROUNDING = 1e-15
_ARMIJO = 1e-4
_SHORTEST_STEP = 1e-8
_TINY = 1e-300


class BlockProblem(NamedTuple):
    """Eq. 7 restricted to p template frames of b sequences, in terms of inner products.

    Parameters
    ----------
    gram : float64 array (p, p)
        X^T X.
    correlations : float64 array (p, q)
        X^T Y.
    squares : float64 array (q,)
        ||y_i||^2, all positive.
    lambda1, lambda2 : float
    starts : intp array (b + 1,)
        Sequence j has the rows starts[j] to starts[j + 1].
    """

    gram: Array
    correlations: Array
    squares: Array
    lambda1: float
    lambda2: float
    starts: NDArray[np.intp]


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
    rows, columns : float64 arrays (p, q)
        U and V. U is the guess that lets `smal.certificate.polar_bound` certify the sequences that were solved for.
    gap : float
        Relative duality gap of the restricted problem.
    epsilon : float
        How smooth the norms were at the end.
    steps : int
        Newton steps.
    """

    weights: Array
    query_shares: Array
    dual_weights: Array
    rows: Array
    columns: Array
    gap: float
    epsilon: float
    steps: int


class _Primal(NamedTuple):
    """W, X^T X W, and the squares of all norms in Eq. 7."""

    W: Array
    products: Array
    residuals: Array
    rows: Array
    columns: Array


class _Dual(NamedTuple):
    """The subgradients: Theta by alpha and B (with X^T X B), U of rows, V of columns of blocks."""

    alpha: Array
    B: Array
    products: Array
    U: Array
    V: Array


class _System(NamedTuple):
    """The Newton system: X^T X / d + diagonal, minus rank-one terms of residuals, rows and columns of blocks."""

    d: Array
    diagonal: Array
    residual_edges: Array
    row_edges: Array
    column_edges: Array
    preconditioner: Array


@compiled
def _dots(left: Array, right: Array) -> Array:
    """<left_i, right_i> for every column i."""
    sums = np.zeros(left.shape[1])
    for r in range(left.shape[0]):
        for i in range(left.shape[1]):
            sums[i] += left[r, i] * right[r, i]
    return sums


@compiled
def _measure(problem: BlockProblem, W: Array, products: Array) -> _Primal:
    p, q = W.shape
    rows, columns = np.zeros(p), np.zeros((problem.starts.size - 1, q))
    residuals = problem.squares.copy()
    for j in range(problem.starts.size - 1):
        for r in range(problem.starts[j], problem.starts[j + 1]):
            for i in range(q):
                residuals[i] -= W[r, i] * (2.0 * problem.correlations[r, i] - products[r, i])
                square = W[r, i] * W[r, i]
                rows[r] += square
                columns[j, i] += square
    return _Primal(W, products, np.maximum(residuals, _ROUNDING * problem.squares), rows, columns)


@compiled
def _objective(problem: BlockProblem, primal: _Primal, epsilon: float) -> float:
    """Eq. 7, every norm smoothed by epsilon."""
    square = epsilon * epsilon
    rows, columns = np.sqrt(primal.rows + square).sum(), np.sqrt(primal.columns + square).sum()
    value: float = np.sqrt(primal.residuals + square).sum() + problem.lambda1 * rows + problem.lambda2 * columns
    return value


@compiled
def smoothing_for(problem: BlockProblem, excess: float) -> float:
    """Return the epsilon that costs about as much as the excess of the objective: 0.3 epsilon per norm, doubled."""
    p, q = problem.correlations.shape
    norms = q + problem.lambda1 * p + problem.lambda2 * q * (problem.starts.size - 1)
    epsilon: float = _GAP_TO_EPSILON * excess / norms
    return epsilon


@compiled
def _start_dual(problem: BlockProblem, primal: _Primal, epsilon: float) -> _Dual:
    """Take the gradients of the smoothed norms."""
    square = epsilon * epsilon
    d, e, f = np.sqrt(primal.residuals + square), np.sqrt(primal.rows + square), np.sqrt(primal.columns + square)
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
def _relative_gap(problem: BlockProblem, primal: _Primal, dual: _Dual) -> float:
    value = (dual.alpha * problem.squares).sum() - _dots(problem.correlations, dual.B).sum()
    gap: float = 1.0 - value / _largest_polar(problem, dual) / _objective(problem, primal, 0.0)
    return gap


@compiled
def _newton_system(problem: BlockProblem, primal: _Primal, dual: _Dual, epsilon: float) -> tuple[_System, Array]:
    """Linearise at W: the system and its right-hand side, minus the slope of the smoothed objective."""
    W, square = primal.W, epsilon * epsilon
    d, e, f = np.sqrt(primal.residuals + square), np.sqrt(primal.rows + square), np.sqrt(primal.columns + square)
    gradients = problem.correlations - primal.products
    # <theta_i, r_i> / d_i, at most 1: how far the curvature of a residual norm is that of a cone.
    radial = dual.alpha * (problem.squares - _dots(problem.correlations, W)) - _dots(dual.B, gradients)
    residual_edges = gradients * np.sqrt(np.maximum(radial, 0.0) / primal.residuals) / d
    diagonal, descent = np.empty_like(W), np.empty_like(W)
    row_edges, column_edges, preconditioner = np.empty_like(W), np.empty_like(W), np.empty_like(W)
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        along = np.maximum(_dots(dual.V[start:end], W[start:end]), 0.0)
        column_scale = np.sqrt(problem.lambda2 * along / np.maximum(primal.columns[j], _TINY)) / f[j]
        for r in range(start, end):
            row_scale = np.sqrt(problem.lambda1 * max(np.dot(dual.U[r], W[r]), 0.0) / max(primal.rows[r], _TINY)) / e[r]
            for i in range(W.shape[1]):
                penalty = problem.lambda1 / e[r] + problem.lambda2 / f[j, i]
                descent[r, i] = gradients[r, i] / d[i] - penalty * W[r, i]
                row_edges[r, i], column_edges[r, i] = row_scale * W[r, i], column_scale[i] * W[r, i]
                diagonal[r, i] = _RIDGE / d[i] + penalty
                edges = residual_edges[r, i] ** 2 + row_edges[r, i] ** 2 + column_edges[r, i] ** 2
                curvature = problem.gram[r, r] / d[i] + diagonal[r, i]
                preconditioner[r, i] = 1.0 / max(curvature - edges, 1e-3 * diagonal[r, i])
    return _System(d, diagonal, residual_edges, row_edges, column_edges, preconditioner), descent


@compiled
def _apply(problem: BlockProblem, system: _System, D: Array, products: Array, result: Array) -> float:
    """Multiply the Newton system with D, given X^T X D; return the curvature <D, result>."""
    p, q = D.shape
    along_residuals, along_columns, curvature = np.zeros(q), np.zeros(q), 0.0
    for r in range(p):
        for i in range(q):
            along_residuals[i] += system.residual_edges[r, i] * D[r, i]
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        along_columns[:] = 0.0
        for r in range(start, end):
            for i in range(q):
                along_columns[i] += system.column_edges[r, i] * D[r, i]
        for r in range(start, end):
            along_row = 0.0
            for i in range(q):
                along_row += system.row_edges[r, i] * D[r, i]
            for i in range(q):
                edges = system.row_edges[r, i] * along_row + system.column_edges[r, i] * along_columns[i]
                edges += system.residual_edges[r, i] * along_residuals[i]
                result[r, i] = products[r, i] / system.d[i] + system.diagonal[r, i] * D[r, i] - edges
                curvature += D[r, i] * result[r, i]
    return curvature


@compiled
def _newton_direction(
    problem: BlockProblem, system: _System, descent: Array, accuracy: float
) -> tuple[Array, Array, bool]:
    """Solve the Newton system by preconditioned conjugate gradients: D, X^T X D, and whether D is accurate."""
    p, q = descent.shape
    D, products, curved = np.zeros_like(descent), np.zeros_like(descent), np.empty_like(descent)
    rest = descent.copy()
    conjugate = system.preconditioner * rest
    size = (rest * conjugate).sum()
    enough = accuracy**2 * size
    for _ in range(_MAX_CONJUGATE):
        if size <= enough:
            break
        image = np.dot(problem.gram, conjugate)
        curvature = _apply(problem, system, conjugate, image, curved)
        if curvature <= 0.0:
            break
        step, before, size = size / curvature, size, 0.0
        for r in range(p):
            for i in range(q):
                D[r, i] += step * conjugate[r, i]
                products[r, i] += step * image[r, i]
                rest[r, i] -= step * curved[r, i]
                size += rest[r, i] * rest[r, i] * system.preconditioner[r, i]
        for r in range(p):
            for i in range(q):
                conjugate[r, i] = system.preconditioner[r, i] * rest[r, i] + (size / before) * conjugate[r, i]
    return D, products, size <= enough


@compiled
def _exact_direction(problem: BlockProblem, system: _System, descent: Array) -> tuple[Array, Array]:
    """Solve the Newton system by inverting one matrix per query frame: D and X^T X D.

    The system is block diagonal with the blocks A_i (one per query frame) minus Z Z^T, one column of Z per row of W
    (Woodbury).
    """
    p, q = descent.shape
    inverses, plain = np.empty((q, p, p)), np.empty((p, q))
    coupling, shared = np.eye(p), np.zeros(p)
    for i in range(q):
        A = problem.gram / system.d[i] - np.outer(system.residual_edges[:, i], system.residual_edges[:, i])
        for j in range(problem.starts.size - 1):
            for r in range(problem.starts[j], problem.starts[j + 1]):
                A[r, r] += system.diagonal[r, i]
                for s in range(problem.starts[j], problem.starts[j + 1]):
                    A[r, s] -= system.column_edges[r, i] * system.column_edges[s, i]
        inverses[i] = np.linalg.inv(A)
        plain[:, i] = np.dot(inverses[i], np.ascontiguousarray(descent[:, i]))
        for r in range(p):
            shared[r] += system.row_edges[r, i] * plain[r, i]
            for s in range(p):
                coupling[r, s] -= system.row_edges[r, i] * inverses[i, r, s] * system.row_edges[s, i]
    common = np.linalg.solve(coupling, shared)
    for i in range(q):
        plain[:, i] += np.dot(inverses[i], system.row_edges[:, i] * common)
    return plain, np.dot(problem.gram, plain)


@compiled
def _line_search(
    problem: BlockProblem, primal: _Primal, direction: Array, products: Array, slope: float, epsilon: float
) -> tuple[_Primal, float]:
    """Halve the step until the smoothed objective falls enough (Armijo)."""
    ceiling = _objective(problem, primal, epsilon) * (1.0 + 1e-14)
    step = 1.0
    while True:
        moved = _measure(problem, primal.W + step * direction, primal.products + step * products)
        if _objective(problem, moved, epsilon) <= ceiling + _ARMIJO * step * slope or step < _SHORTEST_STEP:
            return moved, step
        step *= 0.5


@compiled
def _move_dual(
    problem: BlockProblem, primal: _Primal, dual: _Dual, direction: Array, products: Array, epsilon: float
) -> _Dual:
    """Linearise the subgradients along the step and bring them back into their balls."""
    square = epsilon * epsilon
    d, e, f = np.sqrt(primal.residuals + square), np.sqrt(primal.rows + square), np.sqrt(primal.columns + square)
    moved = primal.W + direction
    # Theta + dTheta = (R + dR) / d - Theta <R, dR> / d^2, in terms of alpha and B.
    along = -_dots(problem.correlations - primal.products, direction) / (d * d)
    alpha = 1.0 / d - dual.alpha * along
    B = moved / d - dual.B * along
    images = (primal.products + products) / d - dual.products * along
    squares = alpha * alpha * problem.squares + _dots(B, images - 2.0 * alpha * problem.correlations)
    shrink = np.sqrt(np.maximum(squares, 1.0))
    U, V = np.empty_like(B), np.empty_like(B)
    for j in range(problem.starts.size - 1):
        start, end = problem.starts[j], problem.starts[j + 1]
        along = _dots(primal.W[start:end], direction[start:end]) / (f[j] * f[j])
        V[start:end] = moved[start:end] / f[j] - dual.V[start:end] * along
        V[start:end] /= np.maximum(np.sqrt(_dots(V[start:end], V[start:end])), 1.0)
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
    p, q = float(W.shape[0]), W.shape[1]
    primal = _measure(problem, W.copy(), np.dot(problem.gram, W))
    dual = _start_dual(problem, primal, epsilon)
    if np.any(U):
        dual = _Dual(dual.alpha, dual.B, dual.products, U.copy(), V.copy())
    gap, steps, accuracy = _relative_gap(problem, primal, dual), 0, _INEXACT
    best, best_primal, best_dual = gap, primal, dual
    while gap > tolerance and steps < _MAX_STEPS:
        system, descent = _newton_system(problem, primal, dual, epsilon)
        direction, products, accurate = _newton_direction(problem, system, descent, accuracy)
        if not accurate and p**3 * q <= _LARGEST_INVERSION:
            direction, products = _exact_direction(problem, system, descent)
        slope = -(descent * direction).sum()
        moved, step = _line_search(problem, primal, direction, products, slope, epsilon)
        dual = _move_dual(problem, primal, dual, step * direction, step * products, epsilon)
        primal = moved
        before, gap = gap, _relative_gap(problem, primal, dual)
        if gap < best:
            best, best_primal, best_dual = gap, primal, dual
        accuracy = _INEXACT if gap < _ENOUGH_PROGRESS * before else max(0.1 * accuracy, _ACCURATE)
        # A larger gap says that Newton's method has not yet caught up with epsilon.
        wanted = smoothing_for(problem, gap * _objective(problem, primal, 0.0))
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

    Lengths are expected near 1 (`smal.working_set` scales them), since epsilon is absolute.

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


@compiled
def block_objective(problem: BlockProblem, weights: Array) -> float:
    """Eq. 7 at the weights (p, q)."""
    return _objective(problem, _measure(problem, weights, np.dot(problem.gram, weights)), 0.0)


def residual_norms(problem: BlockProblem, weights: Array) -> Array:
    """||y_i - X w_i|| of every query frame."""
    along = np.einsum("pi,pi->i", weights, 2.0 * problem.correlations - problem.gram @ weights)
    norms: Array = np.sqrt(np.maximum(problem.squares - along, _ROUNDING * problem.squares))
    return norms
