r"""Upper bounds that make a dual point of Eq. 7 feasible.

The dual of Eq. 7 is: maximize <Theta, Y> subject to ||theta_i||_2 <= 1 for every query frame i, and, for every
template sequence j, G = X_j^T Theta (l x q) in lambda1 * {rows in the unit ball} + lambda2 * {columns in the unit
ball}. The polar of the penalty of one sequence, ||W||_{2,1} times lambda1 plus the column norms times lambda2, is
the smallest s for which G / s is in that set. Dividing Theta by the largest upper bound of all polars or by the
length of its longest column, whichever is larger (if it exceeds 1), gives a feasible point, whose value bounds the
optimum of Eq. 7 from below.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.paper.compiled import compiled

Array = NDArray[np.float64]

# Stands in for the length of a zero row or column; its inverse does not overflow.
_TINY = 1e-150


@compiled
def bound_by_lengths(longest_row: float, longest_column: float, lambda1: float, lambda2: float) -> float:
    """Bound the polar of any G whose rows and columns are no longer than these.

    With a the longest row and b the longest column of G, the rows of U = G / a and the columns of V = G / b are in the
    unit ball, and G = s (lambda1 U + lambda2 V) for s = 1 / (lambda1 / a + lambda2 / b). So s bounds the polar; it is
    exact for diagonal and for flat blocks.
    """
    return 1.0 / (lambda1 / max(longest_row, _TINY) + lambda2 / max(longest_column, _TINY))


@compiled
def cheap_polar_bound(gradient: NDArray[Any], lambda1: float, lambda2: float) -> float:
    """Bound the polar of one sequence, G (l, q), from its longest row and its longest column."""
    longest_row, columns = 0.0, np.zeros(gradient.shape[1])
    for r in range(gradient.shape[0]):
        row = 0.0
        for i in range(gradient.shape[1]):
            square = np.float64(gradient[r, i]) ** 2
            row += square
            columns[i] += square
        longest_row = max(longest_row, row)
    return bound_by_lengths(np.sqrt(longest_row), np.sqrt(columns.max()), lambda1, lambda2)


@compiled
def _row_balls(A: Array) -> Array:
    """Bring every row back into the unit ball."""
    inside: Array = A / np.expand_dims(np.maximum(np.sqrt((A * A).sum(axis=1)), 1.0), 1)
    return inside


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
        Not negative, at least one positive.
    U, V : float64 arrays (l, q)
        U is a guess; both are overwritten by the last split.
    rounds : int
        Alternating projections after the first.
    enough : float
        Stop as soon as the bound is not larger.
    """
    best = cheap_polar_bound(gradient, lambda1, lambda2)
    U[:], V[:] = _row_balls(U), 0.0
    for turn in range(rounds + 1):
        if turn > 0 and lambda1 > 0.0:
            U[:] = _row_balls((gradient - lambda2 * V) / lambda1)
        if lambda2 > 0.0:
            V[:] = _row_balls((gradient - lambda1 * U).T / lambda2).T
        best = min(best, 1.0 + cheap_polar_bound(gradient - lambda1 * U - lambda2 * V, lambda1, lambda2))
        if best <= enough:
            break
    return best


@compiled
def polar_bounds(
    gradients: NDArray[Any],
    radii: Array,
    starts: NDArray[np.intp],
    lambdas: tuple[float, float],
    split: tuple[Array, Array],
    rounds: int,
    enough: float,
    bounds: Array,
) -> None:
    """Bound the polars of many sequences, cheaply where that is enough.

    Parameters
    ----------
    gradients : float array (r, q)
        X^T Theta, or an estimate.
    radii : float64 array (r,)
        How far each row of the true X^T Theta may be; the bounds hold for the true one.
    starts : intp array (k + 1,)
        Sequence j has the rows starts[j] to starts[j + 1].
    lambdas, split, rounds, enough
        As in `polar_bound`; the split is U and V of all rows.
    bounds : float64 array (k,)
        Where they go. (Nothing is returned: making a Python object of an array runs Python code, which an interrupt
        would break off in the middle.)
    """
    lambda1, lambda2 = lambdas
    for block in range(bounds.size):
        start, end = starts[block], starts[block + 1]
        # The polar of the error, by which that of the truth is at most larger.
        off = radii[start:end]
        error = bound_by_lengths(off.max(), np.sqrt((off * off).sum()), lambda1, lambda2)
        bound = cheap_polar_bound(gradients[start:end], lambda1, lambda2) + error
        if bound > enough and error < 1.0:
            # Split into a part within (1 - error) times the dual set, if that can be done.
            inside = 1.0 - error
            G, U, V = gradients[start:end].astype(np.float64) / inside, split[0][start:end], split[1][start:end]
            least = polar_bound(G, lambda1, lambda2, U, V, rounds, (enough - error) / inside)
            bound = min(bound, inside * least + error)
        bounds[block] = bound
