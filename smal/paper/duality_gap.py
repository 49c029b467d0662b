r"""Proof of a solution of Eq. 7: its dual problem, and bounds that hold in spite of rounding.

The dual of Eq. 7 is: maximize <Theta, Y> subject to ||theta_i||_2 <= 1 for every query frame i, and, for every
template sequence j, G = X_j^T Theta (l x q) in lambda1 * {rows in the unit ball} + lambda2 * {columns in the unit
ball}. The polar of the penalty of one sequence is the smallest s for which G / s is in that set. Any Theta, divided
by the largest polar or by its longest column (if that exceeds 1), is a point of the dual problem, and its value is a
lower bound on the optimum of Eq. 7.
"""

from typing import Any

import numpy as np

from smal.arrays import AnyArray, Floats

_TINY = 1e-150  # Replaces the length of a zero row or column; its inverse does not overflow.


def rounding(terms: int, kind: type[np.floating[Any]] = np.float64) -> float:
    """Bound the relative error of an inner product of `terms` terms, for any order of summation.

    gamma_m = m u / (1 - m u) with u = 2^-53, or 2^-24 in float32 (Higham, Accuracy and Stability of Numerical
    Algorithms, 3.1).
    """
    unit = terms * float(np.finfo(kind).eps) / 2.0
    return unit / (1.0 - unit) if unit < 1.0 else np.inf


def bound_by_lengths(
    longest_row: Floats, longest_column: Floats, lambda1: float, lambda2: float
) -> Floats:
    """Bound the polar of any G with rows and columns up to these lengths.

    With a the longest row and b the longest column of G, the rows of U = G / a and the columns of V = G / b are in the
    unit ball, and G = s (lambda1 U + lambda2 V) for s = 1 / (lambda1 / a + lambda2 / b). So s bounds the polar.
    """
    by_rows = lambda1 / np.maximum(longest_row, _TINY)
    by_columns = lambda2 / np.maximum(longest_column, _TINY)
    bound: Floats = 1.0 / (by_rows + by_columns)
    return bound


def quick_bounds(blocks: AnyArray, lambda1: float, lambda2: float) -> Floats:
    """Bound the polar of each G of (b, l, q) by its longest row and its longest column, (b,)."""
    squares = np.square(blocks, dtype=np.float64)
    rows = squares.sum(axis=2).max(axis=1)
    columns = squares.sum(axis=1).max(axis=1)
    return bound_by_lengths(np.sqrt(rows), np.sqrt(columns), lambda1, lambda2)


def polar_bounds(
    blocks: Floats, lambda1: float, lambda2: float, guess: Floats, rounds: int, enough: float = 0.0
) -> tuple[Floats, Floats]:
    """Bound the polar of each G of (b, l, q) sharply, by a split G = lambda1 U + lambda2 V + E.

    U and V in their balls have polar at most 1, E is bounded quickly, and the polar is a norm: 1 + bound(E).
    Alternating projections, `rounds` after the first, shrink E from a guess of U, until no bound is above `enough`.
    Returns the bounds (b,), and V of the last split.
    """
    best = quick_bounds(blocks, lambda1, lambda2)
    U = _inside(guess, axis=2)
    V = np.zeros_like(blocks)
    for turn in range(rounds + 1):
        if turn > 0 and lambda1 > 0.0:
            U = _inside((blocks - lambda2 * V) / lambda1, axis=2)
        if lambda2 > 0.0:
            V = _inside((blocks - lambda1 * U) / lambda2, axis=1)
        rest = quick_bounds(blocks - lambda1 * U - lambda2 * V, lambda1, lambda2)
        best = np.minimum(best, 1.0 + rest)
        if best.max(initial=0.0) <= enough:
            break
    return best, V


def _inside(vectors: Floats, axis: int) -> Floats:
    """Project vectors along an axis onto the unit ball."""
    length = np.linalg.norm(vectors, axis=axis, keepdims=True)
    inside: Floats = vectors / np.maximum(length, 1.0)
    return inside
