"""Inner products of many templates with a few vectors, in one pass over the templates.

This product is what matching costs. BLAS repacks a large matrix before it multiplies, which does not pay for a
narrow product; here every entry of a template is read once and used for five vectors while it is in a register.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled

_float = np.float32


@compiled
def _four_by_five(X: NDArray[Any], T: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Multiply four templates with five vectors; the twenty sums stay in registers."""
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = c0 = c1 = c2 = c3 = _float(0.0)
    d0 = d1 = d2 = d3 = e0 = e1 = e2 = e3 = _float(0.0)
    for k in range(X.shape[1]):
        x0, x1, x2, x3 = _float(X[0, k]), _float(X[1, k]), _float(X[2, k]), _float(X[3, k])
        t = T[0, k]
        a0 += x0 * t
        a1 += x1 * t
        a2 += x2 * t
        a3 += x3 * t
        t = T[1, k]
        b0 += x0 * t
        b1 += x1 * t
        b2 += x2 * t
        b3 += x3 * t
        t = T[2, k]
        c0 += x0 * t
        c1 += x1 * t
        c2 += x2 * t
        c3 += x3 * t
        t = T[3, k]
        d0 += x0 * t
        d1 += x1 * t
        d2 += x2 * t
        d3 += x3 * t
        t = T[4, k]
        e0 += x0 * t
        e1 += x1 * t
        e2 += x2 * t
        e3 += x3 * t
    out[0, 0], out[0, 1], out[0, 2], out[0, 3], out[0, 4] = a0, b0, c0, d0, e0
    out[1, 0], out[1, 1], out[1, 2], out[1, 3], out[1, 4] = a1, b1, c1, d1, e1
    out[2, 0], out[2, 1], out[2, 2], out[2, 3], out[2, 4] = a2, b2, c2, d2, e2
    out[3, 0], out[3, 1], out[3, 2], out[3, 3], out[3, 4] = a3, b3, c3, d3, e3


@compiled
def _rows_by_one(X: NDArray[Any], t: NDArray[np.float32], out: NDArray[np.float32], column: int) -> None:
    """Multiply templates with one vector."""
    for r in range(X.shape[0]):
        total = _float(0.0)
        for k in range(X.shape[1]):
            total += _float(X[r, k]) * t[k]
        out[r, column] = total


@compiled
def _multiply(X: NDArray[Any], T: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    n, q = X.shape[0], T.shape[0]
    # In slices that stay in the cache while all vectors are taken.
    for start in range(0, n, 8):
        end = min(start + 8, n)
        tiled = 0
        if end - start == 8:
            tiled = q - q % 5
            for i in range(0, tiled, 5):
                _four_by_five(X[start : start + 4], T[i : i + 5], out[start : start + 4, i : i + 5])
                _four_by_five(X[start + 4 : end], T[i : i + 5], out[start + 4 : end, i : i + 5])
        for i in range(tiled, q):
            _rows_by_one(X[start:end], T[i], out[start:end], i)


@compiled
def _four_lengths(
    X: NDArray[np.float32], t: NDArray[np.float32], out: NDArray[np.float32], squares: NDArray[np.float32]
) -> None:
    """Multiply four templates with one vector, and with themselves."""
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = _float(0.0)
    for k in range(X.shape[1]):
        x0, x1, x2, x3 = X[0, k], X[1, k], X[2, k], X[3, k]
        a0 += x0 * t[k]
        a1 += x1 * t[k]
        a2 += x2 * t[k]
        a3 += x3 * t[k]
        b0 += x0 * x0
        b1 += x1 * x1
        b2 += x2 * x2
        b3 += x3 * x3
    out[0, 0], out[1, 0], out[2, 0], out[3, 0] = a0, a1, a2, a3
    squares[0], squares[1], squares[2], squares[3] = b0, b1, b2, b3


@compiled
def _multiply_and_measure(
    X: NDArray[np.float32], T: NDArray[np.float32], out: NDArray[np.float32], squares: NDArray[np.float32]
) -> None:
    n, q = X.shape[0], T.shape[0]
    whole = n - n % 4
    for start in range(0, whole, 4):
        end = start + 4
        tiled = q - q % 5
        for i in range(0, tiled, 5):
            _four_by_five(X[start:end], T[i : i + 5], out[start:end, i : i + 5])
        for i in range(tiled, q - 1):
            _rows_by_one(X[start:end], T[i], out[start:end], i)
        _four_lengths(X[start:end], T[q - 1], out[start:end, q - 1 :], squares[start:end])
    for r in range(whole, n):
        for i in range(q):
            _rows_by_one(X[r : r + 1], T[i], out[r : r + 1], i)
        squares[r] = (X[r] * X[r]).sum()


def narrow_product(rows: NDArray[Any], vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply templates with a few vectors.

    Parameters
    ----------
    rows : float32 or int8 array (n, m)
        One template a row, contiguous.
    vectors : float32 array (q, m)
        One vector a row, contiguous.

    Returns
    -------
    float32 array (n, q)
        Each sum is off by at most `rounding(m)` times the product of the two lengths.
    """
    out = np.empty((rows.shape[0], vectors.shape[0]), dtype=np.float32)
    _multiply(rows, vectors, out)
    return out


def narrow_product_and_squares(
    rows: NDArray[np.float32], vectors: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Multiply as `narrow_product`, and find the squared lengths (n,) of the templates in the same pass."""
    out = np.empty((rows.shape[0], vectors.shape[0]), dtype=np.float32)
    squares = np.empty(rows.shape[0], dtype=np.float32)
    _multiply_and_measure(rows, vectors, out, squares)
    return out, squares


def rounding(m: int, kind: type[np.floating[Any]] = np.float32) -> float:
    """Bound on the relative error of an inner product of m terms, whatever the order of summation.

    gamma_m = m u / (1 - m u) with u = 2^-24 in float32 (Higham, Accuracy and Stability of Numerical Algorithms, 3.1).
    """
    unit = m * float(np.finfo(kind).eps) / 2.0
    return unit / (1.0 - unit) if unit < 1.0 else np.inf
