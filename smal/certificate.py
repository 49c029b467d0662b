r"""Upper bounds that make a dual point of Eq. 7 feasible.

The dual of Eq. 7 is: maximise <Theta, Y> subject to ||theta_i||_2 <= 1 for every query frame i, and, for every
template sequence j, G = X_j^T Theta (l x q) in lambda1 * {rows in the unit ball} + lambda2 * {columns in the unit
ball}. The polar of the penalty of one sequence, ||W||_{2,1} times lambda1 plus the column norms times lambda2, is
the smallest s for which G / s is in that set. Dividing Theta by the largest upper bound of all polars (if it
exceeds 1) gives a feasible point, whose value bounds the optimum of Eq. 7 from below.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Stands in for the length of a zero row or column; its inverse does not overflow.
_TINY = 1e-150


def cheap_polar_bounds(gradients: NDArray[np.floating], lambda1: float, lambda2: float) -> Array:
    """Bound the polar of every block from its longest row and its longest column.

    With a the longest row and b the longest column of G, U = V = G / (lambda1 + lambda2) weighted by a and b
    splits G with the value 1 / (lambda1 / a + lambda2 / b), which is exact for diagonal and for flat blocks.

    Parameters
    ----------
    gradients : array (b, l, q)
    lambda1, lambda2 : float
        Not negative, at least one positive.

    Returns
    -------
    float64 array (b,)
    """
    squares = np.square(gradients, dtype=np.float64)
    rows = np.sqrt(squares.sum(axis=2).max(axis=1))
    columns = np.sqrt(squares.sum(axis=1).max(axis=1))
    bounds: Array = 1.0 / (lambda1 / np.maximum(rows, _TINY) + lambda2 / np.maximum(columns, _TINY))
    return bounds


def _into_balls(vectors: Array, axis: int) -> Array:
    """Project the vectors along an axis onto the unit ball."""
    norms = np.sqrt(np.square(vectors).sum(axis=axis, keepdims=True))
    inside: Array = vectors / np.maximum(norms, 1.0)
    return inside


def polar_bounds(gradients: Array, lambda1: float, lambda2: float, rows: Array, rounds: int = 0) -> Array:
    """Bound the polar of every block from a split G = lambda1 U + lambda2 V + E.

    U and V in their balls have polar at most 1, E is bounded cheaply, and the polar is a norm: 1 + bound(E).
    The split starts from a guess of U; alternating projections shrink E.

    Parameters
    ----------
    gradients : float64 array (b, l, q)
    lambda1, lambda2 : float
    rows : float64 array (b, l, q)
        Guess of U; rows longer than 1 are shortened.
    rounds : int
        Alternating projections after the first.

    Returns
    -------
    float64 array (b,)
    """
    U = _into_balls(rows, axis=2)
    V = np.zeros_like(U)
    for turn in range(rounds + 1):
        if turn and lambda1 > 0.0:
            U = _into_balls((gradients - lambda2 * V) / lambda1, axis=2)
        if lambda2 > 0.0:
            V = _into_balls((gradients - lambda1 * U) / lambda2, axis=1)
    rest = gradients - lambda1 * U - lambda2 * V
    return np.minimum(1.0 + cheap_polar_bounds(rest, lambda1, lambda2), cheap_polar_bounds(gradients, lambda1, lambda2))
