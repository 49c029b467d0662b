"""Directions for Newton's method on the smoothed Eq. 7: the system, and two ways to solve it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled
from smal.matching.block_problem import BlockProblem

Array = NDArray[np.float64]

# Conjugate gradients beyond so many steps cost more than inversions do, unless p^3 q is larger than this.
_MAX_CONJUGATE = 150
_LARGEST_INVERSION = 1e9
# A direction that need not be more accurate is found with X^T X in float32, in half the time; the step that is made
# is measured in float64.
_COARSE = 5e-4


class System(NamedTuple):
    """The Newton system: X^T X / d + diagonal, minus rank-one terms of residuals, rows and columns of blocks."""

    d: Array
    diagonal: Array
    residual_edges: Array
    row_edges: Array
    column_edges: Array
    preconditioner: Array


@compiled
def _apply(problem: BlockProblem, system: System, D: Array, products: Array, result: Array) -> float:
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
def _conjugate_gradients(
    problem: BlockProblem, system: System, descent: Array, accuracy: float
) -> tuple[Array, Array, bool]:
    """Solve the Newton system by preconditioned conjugate gradients: D, X^T X D, and whether D is accurate."""
    p, q = descent.shape
    D, curved, rest = np.zeros_like(descent), np.empty_like(descent), descent.copy()
    rounded = problem.gram.astype(np.float32) if accuracy >= _COARSE else np.empty((0, 0), dtype=np.float32)
    conjugate = system.preconditioner * rest
    size = float((rest * conjugate).sum())
    enough = accuracy**2 * size
    for _ in range(_MAX_CONJUGATE):
        if size <= enough:
            break
        if rounded.size:
            image = np.dot(rounded, conjugate.astype(np.float32)).astype(np.float64)
        else:
            image = np.dot(problem.gram, conjugate)
        curvature = _apply(problem, system, conjugate, image, curved)
        if curvature <= 0.0:
            break
        step, before, size = size / curvature, size, 0.0
        for r in range(p):
            for i in range(q):
                D[r, i] += step * conjugate[r, i]
                rest[r, i] -= step * curved[r, i]
                size += rest[r, i] * rest[r, i] * system.preconditioner[r, i]
        for r in range(p):
            for i in range(q):
                conjugate[r, i] = system.preconditioner[r, i] * rest[r, i] + (size / before) * conjugate[r, i]
    return D, np.dot(problem.gram, D), bool(size <= enough)


@compiled
def _exact_direction(problem: BlockProblem, system: System, descent: Array) -> tuple[Array, Array]:
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
def newton_direction(problem: BlockProblem, system: System, descent: Array, accuracy: float) -> tuple[Array, Array]:
    """Solve the Newton system, as accurately as wanted: D and X^T X D."""
    p, q = float(descent.shape[0]), descent.shape[1]
    direction, products, accurate = _conjugate_gradients(problem, system, descent, accuracy)
    if not accurate and p**3 * q <= _LARGEST_INVERSION:
        return _exact_direction(problem, system, descent)
    return direction, products
