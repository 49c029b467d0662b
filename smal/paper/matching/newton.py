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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.paper.compiled import compiled
from smal.paper.matching.certificate import polar_bounds

Array = NDArray[np.float64]

#: Where smoothing starts without a better guess; lengths are near 1.
FIRST_EPSILON = 0.3
_LAST_EPSILON = 1e-9
_FASTEST = 0.2
_GAP_TO_EPSILON = 0.7
_MAX_STEPS = 150
# A Newton direction need not be more accurate than this, since the next step corrects it, while the gap falls.
_INEXACT, _ACCURATE = 0.1, 1e-4
_ENOUGH_PROGRESS = 0.7
# Conjugate gradients beyond so many steps cost more than inversions do, unless p^3 q is larger than this.
_MAX_CONJUGATE, _LARGEST_INVERSION = 150, 1e9
# Rounding must not make a Newton system indefinite; it changes the path, never the certificate.
_RIDGE = 1e-11
_ARMIJO, _SHORTEST_STEP = 1e-4, 1e-8
# Squared residuals below this share of the query are rounding.
_ROUNDING = 1e-15
_TINY = 1e-300


class BlockProblem(NamedTuple):
    """Eq. 7 restricted to p template frames of b sequences, in terms of inner products.

    Parameters
    ----------
    gram, correlations : float64 arrays (p, p), (p, q)
        X^T X and X^T Y.
    squares : float64 array (q,)
        ||y_i||^2, all positive, near 1.
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


class Iterate(NamedTuple):
    """W, the dual point Theta = Y diag(alpha) - X B, and the subgradients U of rows and V of columns of blocks.

    All float64 (p, q) but alpha (q,). U is the guess that lets `certificate.polar_bound` certify the sequences.
    """

    W: Array
    alpha: Array
    B: Array
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
def _rows(A: Array) -> Array:
    """Sum up every row (p, 1)."""
    return np.expand_dims(A.sum(axis=1), 1)


@compiled
def _blocks(A: Array, starts: NDArray[np.intp]) -> Array:
    """Sum up the columns of blocks, each for all rows of its block (p, q)."""
    sums = np.zeros_like(A)
    for j in range(starts.size - 1):
        for r in range(starts[j], starts[j + 1]):
            for i in range(A.shape[1]):
                sums[starts[j], i] += A[r, i]
        for r in range(starts[j] + 1, starts[j + 1]):
            sums[r] = sums[starts[j]]
    return sums


@compiled
def _norms(problem: BlockProblem, W: Array, image: Array, epsilon: float) -> tuple[Array, Array, Array]:
    """Find the norms of residuals (q,), rows (p, 1) and columns of blocks (p, q), smoothed; image is X^T X W."""
    residuals = problem.squares - (W * (2.0 * problem.correlations - image)).sum(axis=0)
    square = epsilon * epsilon
    d = np.sqrt(np.maximum(residuals, _ROUNDING * problem.squares) + square)
    return d, np.sqrt(_rows(W * W) + square), np.sqrt(_blocks(W * W, problem.starts) + square)


@compiled
def _objective(problem: BlockProblem, W: Array, image: Array, epsilon: float) -> float:
    d, e, f = _norms(problem, W, image, epsilon)
    value: float = d.sum() + problem.lambda1 * e.sum() + problem.lambda2 * f[problem.starts[:-1]].sum()
    return value


@compiled
def block_objective(problem: BlockProblem, W: Array) -> float:
    """Eq. 7 at W (p, q)."""
    return _objective(problem, W, np.dot(problem.gram, W), 0.0)


@compiled
def smoothing_for(problem: BlockProblem, excess: float) -> float:
    """Return the epsilon that costs about as much as the excess of the objective: 0.3 epsilon per norm, doubled."""
    p, q = problem.correlations.shape
    norms = q + problem.lambda1 * p + problem.lambda2 * q * (problem.starts.size - 1)
    epsilon: float = _GAP_TO_EPSILON * excess / norms
    return epsilon


@compiled
def _relative_gap(problem: BlockProblem, now: Iterate, image: Array, dual_image: Array) -> float:
    gradients, bounds = problem.correlations * now.alpha - dual_image, np.ones(problem.starts.size - 1)
    split, lambdas = (now.U.copy(), np.empty_like(now.U)), (problem.lambda1, problem.lambda2)
    polar_bounds(gradients, np.zeros(len(now.U)), problem.starts, lambdas, split, 2, 1.0, bounds)
    largest = 1.0
    for bound in bounds:
        largest = max(largest, bound)
    value = (now.alpha * problem.squares).sum() - (problem.correlations * now.B).sum()
    gap: float = 1.0 - value / largest / _objective(problem, now.W, image, 0.0)
    return gap


@compiled
def _newton_system(problem: BlockProblem, now: Iterate, image: Array, epsilon: float) -> tuple[_System, Array]:
    """Linearise at W: the system and its right-hand side, minus the slope of the smoothed objective."""
    W, alpha, B, U, V = now
    d, e, f = _norms(problem, W, image, epsilon)
    gradients = problem.correlations - image
    # <theta_i, r_i> / d_i, at most 1: how far the curvature of a residual norm is that of a cone.
    radial = alpha * (problem.squares - (problem.correlations * W).sum(axis=0)) - (B * gradients).sum(axis=0)
    squares = np.maximum(d * d - epsilon * epsilon, _ROUNDING * problem.squares)
    residual_edges = gradients * (np.sqrt(np.maximum(radial, 0.0) / squares) / d)
    along_rows, along_columns = np.maximum(_rows(U * W), 0.0), np.maximum(_blocks(V * W, problem.starts), 0.0)
    row_edges = W * (np.sqrt(problem.lambda1 * along_rows / np.maximum(_rows(W * W), _TINY)) / e)
    squares = np.maximum(_blocks(W * W, problem.starts), _TINY)
    column_edges = W * (np.sqrt(problem.lambda2 * along_columns / squares) / f)
    penalty = problem.lambda1 / e + problem.lambda2 / f
    diagonal = _RIDGE / d + penalty
    edges = residual_edges**2 + row_edges**2 + column_edges**2
    curvature = np.expand_dims(np.diag(problem.gram), 1) / d + diagonal
    preconditioner = 1.0 / np.maximum(curvature - edges, 1e-3 * diagonal)
    return _System(d, diagonal, residual_edges, row_edges, column_edges, preconditioner), gradients / d - penalty * W


@compiled
def _apply(problem: BlockProblem, system: _System, D: Array) -> Array:
    """Multiply the Newton system with D."""
    residual_edges, row_edges, column_edges = system.residual_edges, system.row_edges, system.column_edges
    result: Array = np.dot(problem.gram, D) / system.d + system.diagonal * D
    result -= residual_edges * (residual_edges * D).sum(axis=0) + row_edges * _rows(row_edges * D)
    result -= column_edges * _blocks(column_edges * D, problem.starts)
    return result


@compiled
def _conjugate_gradients(problem: BlockProblem, system: _System, descent: Array, accuracy: float) -> tuple[Array, bool]:
    """Solve the Newton system by preconditioned conjugate gradients: D, and whether it is accurate."""
    D, rest = np.zeros_like(descent), descent.copy()
    conjugate = system.preconditioner * rest
    size = float((rest * conjugate).sum())
    enough = accuracy**2 * size
    for _ in range(_MAX_CONJUGATE):
        if size <= enough:
            break
        curved = _apply(problem, system, conjugate)
        curvature = (conjugate * curved).sum()
        if curvature <= 0.0:
            break
        step, before = size / curvature, size
        D += step * conjugate
        rest -= step * curved
        size = (rest * rest * system.preconditioner).sum()
        conjugate = system.preconditioner * rest + (size / before) * conjugate
    return D, bool(size <= enough)


@compiled
def _exact_direction(problem: BlockProblem, system: _System, descent: Array) -> Array:
    """Solve the Newton system by inverting one matrix per query frame.

    The system is block diagonal with the blocks A_i (one per query frame) minus Z Z^T, one column of Z per row of W
    (Woodbury).
    """
    p, q = descent.shape
    inverses, D, coupling = np.empty((q, p, p)), np.empty((p, q)), np.eye(p)
    for i in range(q):
        residual_edges, row_edges = system.residual_edges[:, i], system.row_edges[:, i]
        A = problem.gram / system.d[i] - np.outer(residual_edges, residual_edges) + np.diag(system.diagonal[:, i])
        for j in range(problem.starts.size - 1):
            start, end = problem.starts[j], problem.starts[j + 1]
            column_edges = system.column_edges[start:end, i]
            A[start:end, start:end] -= np.outer(column_edges, column_edges)
        inverses[i] = np.linalg.inv(A)
        D[:, i] = np.dot(inverses[i], np.ascontiguousarray(descent[:, i]))
        coupling -= np.outer(row_edges, row_edges) * inverses[i]
    shared = np.linalg.solve(coupling, (system.row_edges * D).sum(axis=1))
    for i in range(q):
        D[:, i] += np.dot(inverses[i], system.row_edges[:, i] * shared)
    return D


@compiled
def _move_dual(problem: BlockProblem, now: Iterate, images: tuple[Array, Array], step: Array, step_image: Array,
               epsilon: float) -> tuple[Iterate, Array]:  # fmt: skip
    """Linearise the subgradients along the step and bring them back into their balls; also X^T X B."""
    W, alpha, B, U, V = now
    image, dual_image = images
    d, e, f = _norms(problem, W, image, epsilon)
    moved = W + step
    # Theta + dTheta = (R + dR) / d - Theta <R, dR> / d^2, in terms of alpha and B.
    along = -((problem.correlations - image) * step).sum(axis=0) / (d * d)
    alpha, B = 1.0 / d - alpha * along, moved / d - B * along
    dual_image = (image + step_image) / d - dual_image * along
    squares = alpha * alpha * problem.squares + (B * (dual_image - 2.0 * alpha * problem.correlations)).sum(axis=0)
    shrink = np.sqrt(np.maximum(squares, 1.0))
    U = moved / e - U * (_rows(W * step) / (e * e))
    V = moved / f - V * (_blocks(W * step, problem.starts) / (f * f))
    U = U / np.maximum(np.sqrt(_rows(U * U)), 1.0)
    V = V / np.maximum(np.sqrt(_blocks(V * V, problem.starts)), 1.0)
    return Iterate(moved, alpha / shrink, B / shrink, U, V), dual_image / shrink


@compiled
def _minimize(problem: BlockProblem, found: Iterate, epsilon: float, tolerance: float) -> tuple[float, int]:
    """Minimize in place; the smoothing, the steps.

    Nothing but numbers is returned: making Python objects of arrays runs Python code, which an interrupt (Ctrl-C)
    would break off in the middle.
    """
    W = found.W.copy()
    image = np.dot(problem.gram, W)
    d, e, f = _norms(problem, W, image, epsilon)
    U, V = (found.U.copy(), found.V.copy()) if np.any(found.U) else (W / e, W / f)
    now, dual_image = Iterate(W, 1.0 / d, W / d, U, V), image / d
    gap, steps, accuracy = _relative_gap(problem, now, image, dual_image), 0, _INEXACT
    best, best_gap = now, gap
    while gap > tolerance and steps < _MAX_STEPS:
        system, descent = _newton_system(problem, now, image, epsilon)
        direction, accurate = _conjugate_gradients(problem, system, descent, accuracy)
        if not accurate and float(len(W)) ** 3 * W.shape[1] <= _LARGEST_INVERSION:
            direction = _exact_direction(problem, system, descent)
        direction_image = np.dot(problem.gram, direction)
        # Halve the step until the smoothed objective falls enough (Armijo).
        slope, share = -(descent * direction).sum(), 1.0
        ceiling = _objective(problem, now.W, image, epsilon) * (1.0 + 1e-14)
        while share >= _SHORTEST_STEP:
            reached = _objective(problem, now.W + share * direction, image + share * direction_image, epsilon)
            if reached <= ceiling + _ARMIJO * share * slope:
                break
            share *= 0.5
        step, step_image = share * direction, share * direction_image
        now, dual_image = _move_dual(problem, now, (image, dual_image), step, step_image, epsilon)
        image = image + step_image
        before, gap = gap, _relative_gap(problem, now, image, dual_image)
        if gap < best_gap:
            best, best_gap = now, gap
        accuracy = _INEXACT if gap < _ENOUGH_PROGRESS * before else max(0.1 * accuracy, _ACCURATE)
        # A larger gap says that Newton's method has not yet caught up with epsilon.
        wanted = smoothing_for(problem, gap * _objective(problem, now.W, image, 0.0))
        epsilon = max(min(max(wanted, _FASTEST * epsilon), epsilon), _LAST_EPSILON)
        steps += 1
    found.W[:], found.alpha[:], found.B[:], found.U[:], found.V[:] = best
    return epsilon, steps


def solve_blocks(problem: BlockProblem, start: Iterate, epsilon: float, tolerance: float) -> tuple[Iterate, float, int]:
    """Minimize Eq. 7 over the weights of a few template frames.

    Parameters
    ----------
    problem : BlockProblem
    start : Iterate
        W, U and V to start with; where U is zero, subgradients of the smoothed norms.
    epsilon : float
        Smoothing to start with: less for a better start.
    tolerance : float
        Relative duality gap at which to stop.

    Returns
    -------
    Iterate
        The best that was reached.
    float, int
        The smoothing at the end, and Newton steps.
    """
    found = Iterate(*(part.copy() for part in start))
    return found, *_minimize(problem, found, epsilon, tolerance)
