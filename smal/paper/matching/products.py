"""Inner products of the template frames with each other, with the query and with dual points.

One product of all templates with a dual point is what matching costs. It is made in float32, with a bound on what
rounding does to it; the few frames that matter are multiplied in float64.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Frames = NDArray[np.float32]
Columns = NDArray[np.intp]

# A first guess looks at one entry of a template in 32, in so many places.
_SHARE, _PLACES = 32, 8
# Known products are combined where their terms are at most so much longer than what is left of them.
_CANCELLATION = 30.0


def narrow_product(rows: Frames, chosen: Columns, vectors: Frames) -> Frames:
    """Multiply chosen templates, rows of (n, m), with a few vectors (q, m).

    Returns
    -------
    float32 array (r, q)
        Each off by at most `rounding(m)` times the product of the two lengths.
    """
    some = rows if chosen.size == len(rows) else rows[chosen]
    products: Frames = some @ vectors.T
    return products


def rounding(m: int, kind: type[np.floating[Any]] = np.float32) -> float:
    """Bound on the relative error of an inner product of m terms, whatever the order of summation.

    gamma_m = m u / (1 - m u) with u = 2^-24 in float32 (Higham, Accuracy and Stability of Numerical Algorithms, 3.1).
    """
    unit = m * float(np.finfo(kind).eps) / 2.0
    return unit / (1.0 - unit) if unit < 1.0 else np.inf


def _lengths(squares: Frames, m: int) -> Array:
    """||x_r||, rounded up, from squares in float32; those below its smallest number count as that."""
    underflow = m * float(np.finfo(np.float32).tiny)
    lengths: Array = np.sqrt(squares.astype(np.float64) * (1.0 + rounding(m)) + underflow)
    return lengths


class Known(NamedTuple):
    """X^T Y (n, q) and X^T X (n, n) in float32, where they were multiplied before."""

    correlations: Frames
    gram: Frames


class DualPoint(NamedTuple):
    """Theta = Y diag(alpha) - X_S B, every column in the unit ball: (q,), (p,), (p, q), and its transpose (q, m)."""

    alpha: Array
    columns: Columns
    B: Array
    theta: Array


class Products:
    """Products of templates and query frames; those of frames in the working set are kept.

    Parameters
    ----------
    rows : float32 array (n, m)
        X^T, a template contiguous.
    query : float64 array (q, m)
        Y^T.
    known : Known, optional
    """

    def __init__(self, rows: Frames, query: Array, known: Known | None) -> None:
        self._rows, self._query, self.known = rows, np.ascontiguousarray(query), known
        #: Bound on the relative error of inner products of query frames, and of sums of these.
        self.rounding = rounding(sum(query.shape) + 2, np.float64)
        #: ||y_i||, rounded up.
        self.norms: Array = np.linalg.norm(self._query, axis=1) * (1.0 + self.rounding)
        #: ||x_r||, rounded up, of templates that were multiplied.
        self.lengths = np.full(len(rows), np.inf) if known is None else _lengths(known.gram.diagonal(), rows.shape[1])
        if known is not None and not (np.isfinite(self.lengths).all() and np.isfinite(known.correlations).all()):
            raise ValueError("known products contain NaN or infinity")
        self._place = np.full(len(rows), -1, dtype=np.intp)
        self._count, self._kept = 0, np.empty((0, rows.shape[1]))
        self._gram, self._correlations = np.empty((0, 0)), np.empty((0, len(query)))

    def guess(self) -> Frames:
        """Correlate a sample of the entries: X^T Y (n, q), roughly and up to a factor, to see where to look first."""
        if self.known is not None:
            return self.known.correlations
        m, q = self._rows.shape[1], len(self._query)
        width = -(-m // (_SHARE * _PLACES))
        query, sums = self._query.astype(np.float32), np.zeros((len(self._rows), q), dtype=np.float32)
        for start in np.unique(np.linspace(0, m - width, _PLACES).astype(np.intp)):
            sums += self._rows[:, start : start + width] @ query[:, start : start + width].T
        return sums

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """X_S^T X_S (p, p) and X_S^T Y (p, q) in float64: a residual near zero needs the digits."""
        new = columns[self._place[columns] < 0]
        if new.size:
            old, self._count = self._count, self._count + new.size
            self._place[new] = np.arange(old, self._count)
            if self._count > len(self._kept):
                smaller, self._kept = self._kept, np.empty((2 * self._count, self._kept.shape[1]))
                self._kept[:old] = smaller[:old]
            self._kept[old : self._count] = self._rows[new]
            fresh = self._kept[old : self._count]
            added = self._kept[: self._count] @ fresh.T
            self._gram = np.block([[self._gram, added[:old]], [added.T]])
            self._correlations = np.concatenate([self._correlations, fresh @ self._query.T])
        places = self._place[columns]
        return self._gram[np.ix_(places, places)], self._correlations[places]

    def combine(self, columns: Columns, weights: Array) -> Array:
        """Sum of the frames S with weights (p, q), as rows (q, m)."""
        padded = np.zeros((self._count, weights.shape[1]))
        padded[self._place[columns]] = weights
        combined: Array = padded.T @ self._kept[: self._count]
        return combined

    def dual_point(self, alpha: Array, columns: Columns, B: Array) -> DualPoint:
        """Find Theta."""
        return DualPoint(alpha, columns, B, alpha[:, None] * self._query - self.combine(columns, B))

    def correlate(self, dual: DualPoint, columns: Columns) -> tuple[Frames, Array]:
        """X_R^T Theta in float32 (r, q), and how far each row may be from the truth (r,)."""
        theta, m = dual.theta, self._rows.shape[1]
        if self.known is not None:
            # Of a residual that nearly vanishes, what is known tells too little.
            reach = np.linalg.norm(dual.alpha * self.norms + self.lengths[dual.columns] @ np.abs(dual.B))
            if reach <= _CANCELLATION * np.linalg.norm(theta):
                values = self._combined(dual, columns)
                if not np.isfinite(values).all():
                    raise ValueError("known products contain NaN or infinity")
                return values, self.lengths[columns] * (rounding(m + dual.columns.size + 6) * reach)
        self._measure(columns[np.isinf(self.lengths[columns])])
        values = narrow_product(self._rows, columns, theta.astype(np.float32))
        return values, self.lengths[columns] * (rounding(m + 2) * np.linalg.norm(theta))

    def _measure(self, columns: Columns) -> None:
        """Find the lengths of templates that are multiplied for the first time."""
        rows = self._rows if columns.size == len(self._rows) else self._rows[columns]
        with np.errstate(over="ignore"):
            squares = np.einsum("rm,rm->r", rows, rows)
        # NaN or infinity anywhere in X shows in these.
        if not np.isfinite(squares).all():
            raise ValueError("templates contain NaN or infinity, or overflow float32 products")
        self.lengths[columns] = _lengths(squares, rows.shape[1])

    def _combined(self, dual: DualPoint, columns: Columns) -> Frames:
        """X_R^T Theta from what is known; X^T X is symmetric, and its rows are contiguous."""
        assert self.known is not None
        correlations, gram = self.known.correlations, self.known.gram[dual.columns]
        if columns.size < len(correlations):
            correlations, gram = correlations[columns], gram[:, columns]
        values: Frames = correlations * dual.alpha.astype(np.float32) - gram.T @ dual.B.astype(np.float32)
        return values

    def exact(self, dual: DualPoint, columns: Columns) -> tuple[Array, Array]:
        """X_R^T Theta in float64, and how far each row may be from the truth."""
        theta, places = dual.theta, self._place[columns]
        values = np.empty((columns.size, len(theta)))
        kept, others = np.flatnonzero(places >= 0), np.flatnonzero(places < 0)
        values[kept] = (self._kept[: self._count] @ theta.T)[places[kept]]
        values[others] = self._rows[columns[others]].astype(np.float64) @ theta.T
        return values, self.lengths[columns] * (self.rounding * np.linalg.norm(theta))

    def residual_norms(self, columns: Columns, weights: Array) -> Array:
        """||y_i - X_S w_i|| (q,), rounded up; from inner products, 1e-8 of a query frame would be noise."""
        norms = np.linalg.norm(self._query - self.combine(columns, weights), axis=1)
        reach = self.norms + self.lengths[columns] @ np.abs(weights)
        above: Array = norms * (1.0 + self.rounding) + rounding(self._count + 2, np.float64) * reach
        return above

    def dual_value(self, theta: Array) -> float:
        """<Theta, Y>, rounded down."""
        value = np.einsum("im,im->", theta, self._query)
        return float(value - self.rounding * (np.linalg.norm(theta, axis=1) @ self.norms))

    def movement(self, before: Array, after: Array) -> tuple[float, float]:
        """Spectral norm and longest column of the difference of two dual points, rounded up."""
        step = after - before
        products = step @ step.T
        above = 1.0 + self.rounding
        spectral = np.sqrt(max(np.linalg.eigvalsh(products)[-1], 0.0))
        return above * float(spectral), above * float(np.sqrt(products.diagonal().max()))
