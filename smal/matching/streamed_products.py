"""Inner products of frames that arrive one by one: nearly all are known when the last frame of a sequence is there."""

import numpy as np
from numpy.typing import NDArray

from smal.matching.frame_ring import KEPT, FrameRing
from smal.matching.inner_products import Columns, DualBounds, DualPoint, Gradients, squared_lengths
from smal.matching.narrow_product import rounding
from smal.matching.template_index import GRAM_PRECISION, IndexAndQuery

Array = NDArray[np.float64]

# Relative error of X^T X and X^T Y; and what is added to a query frame, as a share of its squared length.
_PRECISION = max(GRAM_PRECISION, KEPT)
_ADDED = 4.0 * _PRECISION


class StreamedProducts:
    """X^T X is known in float32, and X^T Y of the template frames that were asked for before.

    A residual near zero would drown in the rounding of X^T X. So every query frame is given another component,
    orthogonal to all templates and about as long as that; `dual_bounds` takes it out of the bound on the optimum.

    Parameters
    ----------
    ring : FrameRing
    places : intp array (q,)
        Of the query's frames, none of them zero.
    gram : float32 array (n, n)
        `TemplateIndex.gram`.
    """

    def __init__(self, ring: FrameRing, places: Columns, gram: NDArray[np.float32]) -> None:
        self._ring, self._places, self._gram = ring, places, gram
        self._norms = ring.norms[places]
        self._squares: Array = np.square(self._norms) * (1.0 + _ADDED)

    @property
    def size(self) -> int:
        """Number of template frames."""
        return len(self._gram)

    @property
    def squares(self) -> Array:
        """||y_i||^2 with the component that was added, float64 (q,)."""
        return self._squares

    def guess(self) -> NDArray[np.float32]:
        """Return what is known of the correlations."""
        return self._ring.estimates(self._places)[0]

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """Look the products up, or multiply where a frame is new."""
        gram = self._gram[np.ix_(columns, columns)].astype(np.float64)
        return gram, self._ring.correlations(columns, self._places).astype(np.float64)

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Combine rows of X^T X with correlations, estimated ones if all are asked for."""
        if columns is not None:
            self._ring.refine(columns, self._places)
        return _combined(self._ring, self._places, self._gram, dual, columns)

    def exact_gradients(self, dual: DualPoint, columns: Columns) -> Array:
        """Combine in float64."""
        gram = self._gram[np.ix_(columns, dual.columns)].astype(np.float64)
        exact: Array = self._ring.correlations(columns, self._places) * dual.alpha - gram @ dual.B
        return exact

    def residual_norms(self, columns: Columns, weights: Array) -> Array:
        """Take the products as they are known."""
        return np.sqrt(squared_lengths(self, columns, np.ones(weights.shape[1]), weights))

    def dual_bounds(self, dual: DualPoint) -> DualBounds:
        """Add up what rounding can do to X^T X and X^T Y, and leave out the component that was added."""
        shares = dual.alpha * self._norms
        weights = self.lengths()[dual.columns] @ np.abs(dual.B)
        correlations = self._ring.correlations(dual.columns, self._places).astype(np.float64)
        value = float(shares @ self._norms - (correlations * dual.B).sum()) - _PRECISION * float(weights @ self._norms)
        squares = 1.0 + _PRECISION * (2.0 * shares + weights) * weights
        entries = (_PRECISION * float(self.lengths().max())) * (shares + weights)
        return DualBounds(value, float(np.sqrt(squares.max())), entries)

    def movement(self, old: DualPoint, new: DualPoint) -> tuple[float, float] | None:
        """Gradients cost less than knowing which of them moved."""
        return None

    def lengths(self) -> Array:
        """||x_r||, float64 (n,)."""
        return self._ring.index.lengths


class StreamedQuery(IndexAndQuery):
    """Template frames are multiplied in float64 where that is needed.

    Parameters
    ----------
    ring : FrameRing
    places : intp array (q,)
        Of the query's frames, none of them zero.
    gram : float32 array (n, n), optional
        `TemplateIndex.gram`, to rule sequences out.
    """

    def __init__(self, ring: FrameRing, places: Columns, gram: NDArray[np.float32] | None) -> None:
        super().__init__(ring.index, ring.frames[places].T)
        self._ring, self._places, self._products = ring, places, gram

    def guess(self) -> NDArray[np.float32]:
        """Return what is known of the correlations."""
        return self._ring.estimates(self._places)[0]

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Combine rows of X^T X for all of them if it is known."""
        if columns is not None or self._products is None:
            return super().gradients(dual, columns, fine=fine)
        return _combined(self._ring, self._places, self._products, dual, None)


def _combined(
    ring: FrameRing, places: Columns, gram: NDArray[np.float32], dual: DualPoint, columns: Columns | None
) -> Gradients:
    """Combine rows of X^T X with what is known of the correlations; of all template frames if columns is None."""
    known, radii = ring.estimates(places, columns)
    products = gram[dual.columns] if columns is None else gram[np.ix_(dual.columns, columns)]
    values = known * dual.alpha.astype(np.float32)
    values -= products.T @ dual.B.astype(np.float32)
    # Each sum is off by rounding(p), and each product in it by the precision of X^T X.
    lengths, shares = ring.index.lengths, dual.alpha * ring.norms[places]
    reach = float((lengths[dual.columns] * np.linalg.norm(dual.B, axis=1)).sum()) + float(np.linalg.norm(shares))
    off = reach * (rounding(dual.columns.size + 4) + _PRECISION)
    far = np.sqrt(np.square(radii) @ np.square(dual.alpha).astype(np.float32)).astype(np.float64)
    return Gradients(values, far * (1.0 + 1e-5) + (lengths if columns is None else lengths[columns]) * off)
