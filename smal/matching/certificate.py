r"""Upper bounds that make a dual point of Eq. 7 feasible.

The dual of Eq. 7 is: maximise <Theta, Y> subject to ||theta_i||_2 <= 1 for every query frame i, and, for every
template sequence j, G = X_j^T Theta (l x q) in lambda1 * {rows in the unit ball} + lambda2 * {columns in the unit
ball}. The polar of the penalty of one sequence, ||W||_{2,1} times lambda1 plus the column norms times lambda2, is
the smallest s for which G / s is in that set. Dividing Theta by the largest upper bound of all polars or by the
length of its longest column, whichever is larger (if it exceeds 1), gives a feasible point, whose value bounds the
optimum of Eq. 7 from below.

Functions of one sequence are compiled and take G as (l, q).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled

Array = NDArray[np.float64]

# Stands in for the length of a zero row or column; its inverse does not overflow.
_TINY = 1e-150


@compiled
def cheap_polar_bound(gradient: NDArray[Any], lambda1: float, lambda2: float) -> float:
    """Bound the polar of one sequence from its longest row and its longest column.

    With a the longest row and b the longest column of G, the rows of U = G / a and the columns of V = G / b are in the
    unit ball, and G = s (lambda1 U + lambda2 V) for s = 1 / (lambda1 / a + lambda2 / b). So s bounds the polar; it is
    exact for diagonal and for flat blocks.

    Parameters
    ----------
    gradient : float array (l, q)
    lambda1, lambda2 : float
        Not negative, at least one positive.
    """
    rows, queries = gradient.shape
    longest_row, longest_column = 0.0, 0.0
    for r in range(rows):
        square = 0.0
        for i in range(queries):
            square += np.float64(gradient[r, i]) ** 2
        longest_row = max(longest_row, square)
    for i in range(queries):
        square = 0.0
        for r in range(rows):
            square += np.float64(gradient[r, i]) ** 2
        longest_column = max(longest_column, square)
    return bound_by_lengths(np.sqrt(longest_row), np.sqrt(longest_column), lambda1, lambda2)


@compiled
def bound_by_lengths(longest_row: float, longest_column: float, lambda1: float, lambda2: float) -> float:
    """Bound the polar of any G whose rows and columns are no longer than these."""
    return 1.0 / (lambda1 / max(longest_row, _TINY) + lambda2 / max(longest_column, _TINY))


@compiled
def _project(gradient: Array, scale: float, other_scale: float, out: Array, other: Array) -> None:
    """Fit out to (gradient - other_scale other) / scale, every row in the unit ball; columns by transposes."""
    rows, columns = gradient.shape
    for r in range(rows):
        square = 0.0
        for i in range(columns):
            out[r, i] = (gradient[r, i] - other_scale * other[r, i]) / scale
            square += out[r, i] ** 2
        if square > 1.0:
            for i in range(columns):
                out[r, i] /= np.sqrt(square)


@compiled
def polar_bound(
    gradient: Array, lambda1: float, lambda2: float, U: Array, V: Array, rounds: int, enough: float
) -> float:
    """Bound the polar of one sequence from a split G = lambda1 U + lambda2 V + E.

    U and V in their balls have polar at most 1, E is bounded cheaply, and the polar is a norm: 1 + bound(E).
    The split starts from a guess of U; alternating projections shrink E.

    Parameters
    ----------
    gradient : float64 array (l, q)
    lambda1, lambda2 : float
        As in `cheap_polar_bound`.
    U : float64 array (l, q)
        Guess with rows in the unit ball; overwritten by the last U.
    V : float64 array (l, q)
        Overwritten by the last V.
    rounds : int
        Alternating projections after the first.
    enough : float
        Stop as soon as the bound is not larger.
    """
    best = cheap_polar_bound(gradient, lambda1, lambda2)
    V[:] = 0.0
    for turn in range(rounds + 1):
        if turn > 0 and lambda1 > 0.0:
            _project(gradient, lambda1, lambda2, U, V)
        if lambda2 > 0.0:
            _project(gradient.T, lambda2, lambda1, V.T, U.T)
        rest = gradient - lambda1 * U - lambda2 * V
        best = min(best, 1.0 + cheap_polar_bound(rest, lambda1, lambda2))
        if best <= enough:
            break
    return best


def row_balls(rows: Array) -> Array:
    """Bring every row back into the unit ball."""
    inside: Array = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1.0)
    return inside


def all_polar_bounds(
    gradients: NDArray[np.float32],
    radii: Array,
    length: int,
    lambda1: float,
    lambda2: float,
    rounds: int,
    enough: float,
) -> Array:
    """Bound the polars of many sequences, cheaply where that is enough.

    Parameters
    ----------
    gradients : float32 array (n, q)
        X^T Theta, or an estimate; sequence j is the rows j * length and following, the last one may be shorter.
    radii : float64 array (n,)
        How far each row of the true X^T Theta may be; the bounds hold for the true one.
    length : int
        l.
    lambda1, lambda2, rounds, enough
        As in `polar_bound`.

    Returns
    -------
    float64 array (k,)
    """
    bounds = np.empty(-(-gradients.shape[0] // length))
    _bound_all(gradients, radii, length, lambda1, lambda2, rounds, enough, bounds)
    return bounds


@compiled
def _bound_all(
    gradients: NDArray[np.float32],
    radii: Array,
    length: int,
    lambda1: float,
    lambda2: float,
    rounds: int,
    enough: float,
    bounds: Array,
) -> None:
    n = gradients.shape[0]
    for block in range(bounds.size):
        start, end = block * length, min(block * length + length, n)
        # The polar of the error, by which that of the truth is at most larger.
        largest, square = 0.0, 0.0
        for r in range(start, end):
            largest, square = max(largest, radii[r]), square + radii[r] ** 2
        error = bound_by_lengths(largest, np.sqrt(square), lambda1, lambda2)
        bound = cheap_polar_bound(gradients[start:end], lambda1, lambda2) + error
        if not (bound <= enough) and error < 1.0:
            gradient = gradients[start:end].astype(np.float64)
            # Split into a part within (1 - error) times the dual set, if that can be done.
            shrunk1, shrunk2 = lambda1 * (1.0 - error), lambda2 * (1.0 - error)
            U = gradient / (lambda1 + lambda2)
            for r in range(end - start):
                U[r] /= max(np.sqrt((U[r] * U[r]).sum()), 1.0)
            wanted = (enough - error) / (1.0 - error)
            split = polar_bound(gradient, shrunk1, shrunk2, U, np.empty_like(U), rounds, wanted)
            bound = min(bound, (1.0 - error) * split + error)
        bounds[block] = bound
