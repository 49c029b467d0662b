"""The objective of the paper (Eq. 7) and its two penalties (Eq. 1 and 6).

A column of W contains the weights of all template frames for one query frame, sequence after sequence (Eq. 2). Eq. 3 to
5 lead to Eq. 7, which is Eq. 5 if lambda2 is 0.
"""

import numpy as np

from smal.arrays import AnyArray, Indices


def l21_norm(matrix: AnyArray) -> float:
    """Return the sum of the l2 norms of the rows (Eq. 1)."""
    rows = np.asarray(matrix, dtype=np.float64)
    return float(np.linalg.norm(rows, axis=1).sum())


def sequence_starts(rows: Indices, sequence_length: int) -> Indices:
    """Return the indices at which another sequence starts among ascending template frames."""
    return np.flatnonzero(np.diff(rows // sequence_length, prepend=-1))


def s1_norm(weights: AnyArray, sequence_length: int, rows: Indices | None = None) -> float:
    """Return the sum of l2 norms of weights (p, q) by query frame and sequence (Eq. 6), of all or ascending rows."""
    if sequence_length < 1:
        raise ValueError(f"sequence_length must be at least 1, got {sequence_length}")
    if weights.shape[0] == 0:
        return 0.0
    squares = np.asarray(weights, dtype=np.float64) ** 2
    frames = np.arange(weights.shape[0]) if rows is None else rows
    starts = sequence_starts(frames, sequence_length)
    return float(np.sqrt(np.add.reduceat(squares, starts, axis=0)).sum())


def objective(
    templates: AnyArray,
    query: AnyArray,
    weights: AnyArray,
    sequence_length: int,
    lambda1: float,
    lambda2: float,
) -> float:
    """Return Eq. 7 at W: ||(XW - Y)^T||_{2,1} + lambda1 ||W||_{2,1} + lambda2 ||W||_{S1}.

    The shapes are W (n, q), X (m, n) and Y (m, q).
    """
    W = np.asarray(weights, dtype=np.float64)
    used = np.flatnonzero(W.any(axis=1))
    X = np.asarray(templates[:, used], dtype=np.float64)
    residual = np.asarray(query, dtype=np.float64) - X @ W[used]
    return l21_norm(residual.T) + lambda1 * l21_norm(W) + lambda2 * s1_norm(W, sequence_length)
