"""The objective of the paper (Eq. 7) and its two penalties (Eq. 1 and 6).

A column of W are the weights of all template frames for one query frame, sequence after sequence (Eq. 2). Eq. 3 to 5
lead to Eq. 7, which is Eq. 5 where lambda2 is 0.
"""

import numpy as np

from smal.arrays import AnyArray, Indices


def l21_norm(matrix: AnyArray) -> float:
    """Sum of the l2 norms of the rows (Eq. 1)."""
    return float(np.linalg.norm(np.asarray(matrix, dtype=np.float64), axis=1).sum())


def sequence_starts(rows: Indices, sequence_length: int) -> Indices:
    """Where another sequence starts among these template frames, which ascend."""
    return np.flatnonzero(np.diff(rows // sequence_length, prepend=-1))


def s1_norm(weights: AnyArray, sequence_length: int, rows: Indices | None = None) -> float:
    """Sum of l2 norms of weights (p, q), of each query frame and sequence (Eq. 6); of all rows, or some, ascending."""
    if sequence_length < 1:
        raise ValueError(f"sequence_length must be at least 1, got {sequence_length}")
    if weights.shape[0] == 0:
        return 0.0
    squares = np.asarray(weights, dtype=np.float64) ** 2
    starts = sequence_starts(np.arange(weights.shape[0]) if rows is None else rows, sequence_length)
    return float(np.sqrt(np.add.reduceat(squares, starts, axis=0)).sum())


def objective(
    templates: AnyArray,
    query: AnyArray,
    weights: AnyArray,
    sequence_length: int,
    lambda1: float,
    lambda2: float,
) -> float:
    """Eq. 7 at W (n, q), of X (m, n) and Y (m, q): ||(XW - Y)^T||_{2,1} + lambda1 ||W||_{2,1} + lambda2 ||W||_{S1}."""
    W = np.asarray(weights, dtype=np.float64)
    used = np.flatnonzero(W.any(axis=1))
    residual = (
        np.asarray(query, dtype=np.float64)
        - np.asarray(templates[:, used], dtype=np.float64) @ W[used]
    )
    return l21_norm(residual.T) + lambda1 * l21_norm(W) + lambda2 * s1_norm(W, sequence_length)
