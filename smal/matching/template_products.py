"""Inner products of template frames that are at hand, computed when matching asks for them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.inner_products import Columns, DualBounds, DualPoint, Gradients, common
from smal.matching.narrow_product import narrow_product, narrow_product_and_squares, rounding

Array = NDArray[np.float64]

# A first guess looks at one entry of a template in 32, in so many places.
_SHARE, _PLACES = 32, 32
# Frames that are multiplied at a time where some are chosen.
_BLOCK = 64
_SMALL = 1e-25


def _lengths(rows: NDArray[Any], squares: NDArray[Any]) -> Array:
    """||x_r||, float64 (n,), rounded up, from squares in float32 or better."""
    lengths: Array = np.sqrt(squares, dtype=np.float64) * (1.0 + rounding(rows.shape[1]))
    # Small squares lose their digits, down to nothing.
    small = squares < _SMALL
    if small.any():
        lengths[small] = np.linalg.norm(rows[small].astype(np.float64), axis=1)
    return lengths


def sample(m: int, places: int = _PLACES) -> tuple[Columns, int]:
    """Where a first guess looks: evenly spread runs of entries, by their starts and their common length."""
    width = -(-m // (_SHARE * places))
    return np.unique(np.linspace(0, m - width, places).astype(np.intp)), width


def spectral_norm(products: Array) -> float:
    """||A||_2 from A A^T, for few rows."""
    return float(np.sqrt(max(np.linalg.eigvalsh(products)[-1], 0.0)))


class _Vectors:
    """Template frames in float64, each converted once, with their inner products; frames are only ever added."""

    def __init__(self, templates: NDArray[Any], query: Array, gram: NDArray[Any] | None) -> None:
        self._templates, self._query, self._known_gram = templates.T, query, gram
        self._columns = np.zeros(0, dtype=np.intp)
        self._place = np.full(templates.shape[1], -1, dtype=np.intp)
        self._rows = np.empty((0, self._templates.shape[1]))
        self._gram = np.empty((0, 0))
        self._correlations = np.empty((0, len(query)))

    def places(self, columns: Columns) -> Columns:
        """Where the frames are, after adding those that are new."""
        found = self._place[columns]
        new = columns[found < 0]
        if new.size:
            self._add(new)
            found = self._place[columns]
        return found

    def _add(self, new: Columns) -> None:
        old, count = self._columns.size, self._columns.size + new.size
        if count > len(self._rows):
            self._rows = _grown(self._rows, (2 * count, self._rows.shape[1]))
            self._gram = _grown(self._gram, (2 * count, 2 * count))
            self._correlations = _grown(self._correlations, (2 * count, len(self._query)))
        self._columns = np.concatenate([self._columns, new])
        self._place[new] = np.arange(old, count)
        self._rows[old:count] = self._templates[new]
        if self._known_gram is None:
            self._gram[old:count, :count] = self._rows[old:count] @ self._rows[:count].T
        else:
            known = self._known_gram[np.ix_(new, self._columns)]
            if not np.isfinite(known).all():
                raise ValueError("gram contains NaN or infinity")
            self._gram[old:count, :count] = known
        self._gram[:old, old:count] = self._gram[old:count, :old].T
        self._correlations[old:count] = self._rows[old:count] @ self._query.T

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """Inner products of frames (p, p), and with the query (p, q)."""
        places = self.places(columns)
        return self._gram[np.ix_(places, places)], self._correlations[places]

    @property
    def rounding(self) -> float:
        """Bound on the error of `combine` and a subtraction, relative to the sum of the lengths of all terms."""
        return rounding(self._columns.size + 2, np.float64)

    def correlate(self, columns: Columns, vectors: Array) -> Array:
        """Inner products of frames with vectors (v, m), as (p, v)."""
        places = self.places(columns)
        products: Array = (self._rows[: self._columns.size] @ vectors.T)[places]
        return products

    def combine(self, columns: Columns, weights: Array) -> Array:
        """Sum of the frames with weights (p, q), as rows (q, m)."""
        padded = np.zeros((self._columns.size, weights.shape[1]))
        padded[self.places(columns)] = weights
        combined: Array = padded.T @ self._rows[: len(padded)]
        return combined


def _grown(array: Array, shape: tuple[int, int]) -> Array:
    """Copy into a larger array."""
    grown = np.empty(shape)
    grown[: array.shape[0], : array.shape[1]] = array
    return grown


class TemplatesAndQuery:
    """Nothing is known but X and Y: one pass over X in float32.

    Parameters
    ----------
    templates : float array (m, n)
        X; contiguous per template (column) is fastest.
    query : float64 array (m, q)
        Y.
    gram : float array (n, n), optional
        X^T X if it is known.
    """

    def __init__(self, templates: NDArray[Any], query: Array, gram: NDArray[Any] | None = None) -> None:
        self._templates = templates
        self._query = np.ascontiguousarray(query.T)
        #: Bound on the relative error of inner products of query frames, and of sums of these.
        self._rounding = rounding(sum(query.shape) + 2, np.float64)
        self._squares: Array = np.square(self._query).sum(axis=1) * (1.0 + self._rounding)
        self._vectors = _Vectors(templates, self._query, gram)
        self._theta: tuple[DualPoint, Array] | None = None
        self._lengths: Array | None = None
        self._block: NDArray[np.float32] | None = None

    @property
    def size(self) -> int:
        """Number of template frames."""
        return int(self._templates.shape[1])

    @property
    def squares(self) -> Array:
        """||y_i||^2, float64 (q,), rounded up."""
        return self._squares

    def guess(self) -> NDArray[np.float32]:
        """Correlate a sample of the entries."""
        # For a single query frame the sampling itself would take most of the time.
        starts, width = sample(self._templates.shape[0], _PLACES if self._query.shape[0] > 1 else _PLACES // 4)
        query = self._query.astype(self._templates.dtype)
        sums = np.zeros((self.size, query.shape[0]), dtype=self._templates.dtype)
        for start in starts:
            sums += self._templates[start : start + width].T @ query[:, start : start + width].T
        return sums.astype(np.float32, copy=False)

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """Convert the frames that are new to float64: a residual near zero needs the digits."""
        return self._vectors.restricted(columns)

    def theta(self, dual: DualPoint) -> Array:
        """Theta^T, float64 (q, m)."""
        if self._theta is None or self._theta[0] is not dual:
            self._theta = dual, dual.alpha[:, None] * self._query - self._vectors.combine(dual.columns, dual.B)
        return self._theta[1]

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Multiply in float32."""
        theta = self.theta(dual)
        if columns is None:
            values = self._correlate_all(theta)
            lengths = self.lengths()
        else:
            values, lengths = self._correlate_some(columns, theta.astype(np.float32))
        return Gradients(values, lengths * (rounding(theta.shape[1] + 2) * np.linalg.norm(theta)))

    def _correlate_some(self, columns: Columns, query: NDArray[np.float32]) -> tuple[NDArray[np.float32], Array]:
        """Products with chosen frames, and their lengths."""
        rows = self._templates.T
        values = np.empty((columns.size, len(query)), dtype=np.float32)
        lengths = np.empty(columns.size)
        # In blocks that stay in the cache: a copy of all chosen frames would be fresh memory, a page fault every 4 KB.
        if self._block is None:
            self._block = np.empty((_BLOCK, rows.shape[1]), dtype=np.float32)
        for start in range(0, columns.size, _BLOCK):
            here = slice(start, start + _BLOCK)
            block = self._block[: columns[here].size]
            for k, column in enumerate(columns[here]):
                block[k] = rows[column]
            values[here], squares = narrow_product_and_squares(block, query)
            lengths[here] = _lengths(block, squares)
        return values, lengths

    def _correlate_all(self, theta: Array) -> NDArray[np.float32]:
        rows, query = self._templates.T, theta.astype(np.float32)
        if rows.dtype == np.float32 and rows.flags.c_contiguous:
            if self._lengths is not None:
                return narrow_product(rows, query)
            values, squares = narrow_product_and_squares(rows, query)
        else:
            values = np.asarray(rows @ query.T, dtype=np.float32)
            squares = np.einsum("mn,mn->n", self._templates, self._templates)
        # NaN or infinity anywhere in X shows in these.
        if not np.isfinite(squares).all():
            raise ValueError("templates contain NaN or infinity, or overflow float32 products")
        self._lengths = _lengths(rows, squares)
        return values

    def exact_gradients(self, dual: DualPoint, columns: Columns) -> Array:
        """Multiply in float64."""
        exact = np.empty((columns.size, dual.alpha.size))
        here, _ = common(columns, dual.columns)
        exact[here] = self._vectors.correlate(columns[here], self.theta(dual))
        others = np.ones(columns.size, dtype=np.bool_)
        others[here] = False
        exact[others] = self._templates.T[columns[others]].astype(np.float64) @ self.theta(dual).T
        return exact

    def residual_norms(self, columns: Columns, weights: Array) -> Array:
        """Subtract entry by entry: from inner products, a residual below 1e-8 of a query frame would be noise."""
        lengths = np.linalg.norm(self._query - self._vectors.combine(columns, weights), axis=1)
        reach = np.sqrt(self._squares) + self.lengths()[columns] @ np.abs(weights)
        above: Array = lengths * (1.0 + self._rounding) + self._vectors.rounding * reach
        return above

    def dual_bounds(self, dual: DualPoint) -> DualBounds:
        """Measure Theta as it is in float64."""
        theta, off = self.theta(dual), self._rounding
        lengths: Array = np.linalg.norm(theta, axis=1) * (1.0 + off)
        value = np.einsum("im,im->i", theta, self._query).sum() - off * (lengths @ np.sqrt(self._squares))
        return DualBounds(float(value), float(lengths.max()), (off * float(self.lengths().max())) * lengths)

    def movement(self, old: DualPoint, new: DualPoint) -> tuple[float, float] | None:
        """Compare the points entry by entry."""
        before = self.theta(old)
        step = self.theta(new) - before
        products = step @ step.T
        above = 1.0 + self._rounding
        return above * spectral_norm(products), above * float(np.sqrt(products.diagonal().max()))

    def lengths(self) -> Array:
        """||x_r||, float64 (n,), rounded up."""
        if self._lengths is None:
            raise RuntimeError("lengths are known after the first gradients of all templates")
        return self._lengths
