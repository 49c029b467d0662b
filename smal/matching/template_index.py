"""Templates prepared for many queries: a copy in eight bits, with rigorous bounds on what the rounding costs.

Every template is rounded to x ~ s k with integers k from -127 to 127 and a scale s of its own. An inner product
with a unit vector is then off by at most the length of the rounding error, which is known exactly and is about a
hundredth: enough to rule out nearly all sequences (`screening`) at a quarter of the memory traffic. Those in doubt are
looked at with the templates themselves, so the answer and its certificate are those of the full problem.

Other bounds were considered. Random vectors have no low-rank projection, and the part of a query that no template
explains is as long as the rest, so that the residual norms of a projection rule out little on real frames either.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled
from smal.matching.inner_products import Columns, DualPoint, Gradients
from smal.matching.narrow_product import narrow_product, rounding
from smal.matching.template_products import TemplatesAndQuery, sample, spectral_norm

Array = NDArray[np.float64]

_LARGEST = 127.0
# X^T X is summed over so many entries in float32, and then in float64; so many of its rows at a time.
_SUMMED, _TILE = 64, 256
#: Relative error of the products in `TemplateIndex.gram`.
GRAM_PRECISION: Final = rounding(_SUMMED + 2)


@compiled
def _round(X: NDArray[np.float32], rounded: NDArray[np.int8], scales: Array, errors: Array, lengths: Array) -> None:
    """Round every row of X, and measure what that loses."""
    n, m = X.shape
    for r in range(n):
        largest = 0.0
        for k in range(m):
            largest = max(largest, abs(np.float64(X[r, k])))
        scale = largest / _LARGEST
        inverse = 1.0 / scale if scale > 0.0 else 0.0
        error, square = 0.0, 0.0
        for k in range(m):
            x = np.float64(X[r, k])
            nearest = np.rint(x * inverse)
            rounded[r, k] = np.int8(nearest)
            error += (x - scale * nearest) ** 2
            square += x * x
        scales[r], errors[r], lengths[r] = scale, np.sqrt(error), np.sqrt(square)


class TemplateIndex:
    """Template frames X, prepared once for matching many queries.

    Takes 5.125 m + 24 bytes a template frame, 4 m of them for X itself (shared with the array given, if that is
    float32 in Fortran order).

    Parameters
    ----------
    templates : float array (m, n)
        X, one template frame a column.

    Raises
    ------
    ValueError
        Not a matrix of finite floating-point numbers.
    """

    def __init__(self, templates: NDArray[Any]) -> None:
        if templates.ndim != 2 or not np.issubdtype(templates.dtype, np.floating):
            raise ValueError(
                f"templates must be a floating-point matrix (m, n), got {templates.dtype} {templates.shape}"
            )
        m, n = templates.shape
        self._rows = np.ascontiguousarray(templates.T, dtype=np.float32)
        self._rounded = np.empty((n, m), dtype=np.int8)
        self._scales, self._errors, self._lengths = np.empty(n), np.empty(n), np.empty(n)
        _round(self._rows, self._rounded, self._scales, self._errors, self._lengths)
        if not np.isfinite(self._lengths).all():
            raise ValueError("templates contain NaN or infinity")
        starts, width = sample(m)
        self._sampled = np.unique((starts[:, None] + np.arange(width)).ravel())
        self._sample = np.ascontiguousarray(self._rows[:, self._sampled])

    @property
    def templates(self) -> NDArray[np.float32]:
        """X, float32 (m, n), contiguous per column."""
        return self._rows.T

    @property
    def shape(self) -> tuple[int, int]:
        """(m, n)."""
        n, m = self._rows.shape
        return m, n

    @property
    def nbytes(self) -> int:
        """Memory of the index, with X."""
        parts = (self._rows, self._rounded, self._sample, self._scales, self._errors, self._lengths)
        return sum(part.nbytes for part in parts)

    @property
    def lengths(self) -> Array:
        """||x_r||, float64 (n,)."""
        return self._lengths

    def gram(self) -> NDArray[np.float32]:
        """X^T X, float32 (n, n): each product is off by at most `GRAM_PRECISION` times the two lengths."""
        n, m = self._rows.shape
        gram = np.empty((n, n), dtype=np.float32)
        for start in range(0, n, _TILE):
            rows, others = self._rows[start : start + _TILE], self._rows[start:]
            sums, part = np.zeros((len(rows), len(others))), np.empty((len(rows), len(others)), dtype=np.float32)
            for k in range(0, m, _SUMMED):
                np.matmul(rows[:, k : k + _SUMMED], others[:, k : k + _SUMMED].T, out=part)
                sums += part
            # Order of summation may differ between x_r x_s and x_s x_r.
            among = sums[:, : len(rows)]
            among[:] = 0.5 * (among + among.T)
            gram[start : start + _TILE, start:] = sums
            gram[start:, start : start + _TILE] = sums.T
        return gram

    def guess(self, vectors: Array) -> NDArray[np.float32]:
        """Correlate a sample of the entries with vectors (q, m): X^T Y, float32 (n, q), roughly and up to a factor."""
        guess: NDArray[np.float32] = self._sample @ vectors[:, self._sampled].astype(np.float32).T
        return guess

    def correlate(self, vectors: Array, columns: Columns | None = None) -> Gradients:
        """Estimate X_R^T Theta from the rounded templates.

        Parameters
        ----------
        vectors : float64 array (q, m)
            Theta^T.
        columns : intp array, optional
            R; all template frames if None.
        """
        chosen = slice(None) if columns is None else columns
        rounded, errors, lengths = self._rounded[chosen], self._errors[chosen], self._lengths[chosen]
        values = narrow_product(rounded, vectors.astype(np.float32))
        values *= self._scales[chosen].astype(np.float32)[:, None]
        # ||Theta^T e|| <= ||Theta||_2 ||e||, and the sums are rounded too.
        spectral = spectral_norm(vectors @ vectors.T)
        radii = errors * spectral + (lengths + errors) * (rounding(vectors.shape[1] + 4) * np.linalg.norm(vectors))
        return Gradients(values, radii)


class IndexAndQuery(TemplatesAndQuery):
    """Prepared templates: one pass over their rounded copy.

    Parameters
    ----------
    index : TemplateIndex
    query : float64 array (m, q)
        Y.
    gram : float array (n, n), optional
        X^T X if it is known.
    """

    def __init__(self, index: TemplateIndex, query: Array, gram: NDArray[Any] | None = None) -> None:
        super().__init__(index.templates, query, gram)
        self._index = index

    def guess(self) -> NDArray[np.float32]:
        """Correlate the sample that the index keeps."""
        return self._index.guess(self._query)

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Multiply in eight bits all or many, in float32 few or where that is asked for."""
        if columns is not None and (fine or 4 * columns.size < self.size):
            return super().gradients(dual, columns)
        return self._index.correlate(self.theta(dual), columns)

    def lengths(self) -> Array:
        """||x_r||, float64 (n,)."""
        return self._index.lengths
