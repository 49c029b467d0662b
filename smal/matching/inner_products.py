"""Inner products of the template frames with each other and with a query, as far as matching asks for them.

Matching needs exact products of the few frames that it works on, and for all others no more than bounds good
enough to rule them out. What those cost depends on what is known beforehand, one class each.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from smal.matching.narrow_product import rounding

Array = NDArray[np.float64]
Columns = NDArray[np.intp]


def common(left: Columns, right: Columns) -> tuple[Columns, Columns]:
    """Where two ascending arrays have the same entries: places in the left one, and in the right one."""
    if not right.size:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    places = np.minimum(np.searchsorted(right, left), right.size - 1)
    here = np.flatnonzero(right[places] == left)
    return here, places[here]


@dataclass(frozen=True, eq=False)
class DualPoint:
    """Theta = Y diag(alpha) - X_S B, every column in the unit ball.

    Parameters
    ----------
    alpha : float64 array (q,)
    columns : intp array (p,)
        S, ascending.
    B : float64 array (p, q)
    U : float64 array (p, q)
        Rows in the unit ball with X_S^T Theta near lambda1 U + lambda2 V, V with columns of blocks in the unit ball.
    """

    alpha: Array
    columns: Columns
    B: Array
    U: Array


@dataclass(frozen=True, eq=False)
class Gradients:
    """X_R^T Theta of some template frames R, and how far each row may be from the truth.

    Parameters
    ----------
    values : float32 array (r, q)
    radii : float64 array (r,)
        Bound on the length of each row's error.
    """

    values: NDArray[np.float32]
    radii: Array


@dataclass(frozen=True, eq=False)
class DualBounds:
    """What is certain about a dual point, rounding included.

    Parameters
    ----------
    value : float
        <Theta, Y> is at least this.
    length : float
        No column of Theta is longer.
    entries : float64 array (q,)
        Bound on the error of each entry of `InnerProducts.exact_gradients`.
    """

    value: float
    length: float
    entries: Array


class InnerProducts(Protocol):
    """What is known about n template frames X and a query Y."""

    @property
    def size(self) -> int:
        """Number of template frames."""

    @property
    def squares(self) -> Array:
        """||y_i||^2, float64 (q,)."""

    def guess(self) -> NDArray[np.float32]:
        """Estimate X^T Y, float32 (n, q), up to a factor: where to look first."""

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """X_S^T X_S (p, p) and X_S^T Y (p, q) in float64."""

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """X_R^T Theta with error bounds, of chosen template frames or of all; fine: bounds as for float32."""

    def exact_gradients(self, dual: DualPoint, columns: Columns) -> Array:
        """X_R^T Theta in float64 (r, q)."""

    def residual_norms(self, columns: Columns, weights: Array) -> Array:
        """||y_i - X_S w_i|| for weights (p, q), float64 (q,), rounded up."""

    def dual_bounds(self, dual: DualPoint) -> DualBounds:
        """Bound the value of Theta and the lengths of its columns, whatever alpha and B were meant to make of it."""

    def movement(self, old: DualPoint, new: DualPoint) -> tuple[float, float] | None:
        """Spectral norm and longest column of Theta_new - Theta_old; None where it does not pay to know."""

    def lengths(self) -> Array:
        """||x_r||, float64 (n,), or bounds on them from above; known after the first `gradients` of all."""


def _rounding(B: Array) -> float:
    """Bound on the error of sums over B (p, q) and over X^T X B, relative to the sum of their absolute terms."""
    return rounding(B.size + 2 * len(B) + 8, np.float64)


def _reach(products: InnerProducts, columns: Columns, alpha: Array, B: Array) -> Array:
    """Sum of the lengths of all terms in the columns of Y diag(alpha) - X_S B."""
    reach: Array = alpha * np.sqrt(products.squares) + products.lengths()[columns] @ np.abs(B)
    return reach


def squared_lengths(products: InnerProducts, columns: Columns, alpha: Array, B: Array) -> Array:
    """Squared lengths of the columns of Y diag(alpha) - X_S B by known products, float64 (q,), rounded up."""
    gram, correlations = products.restricted(columns)
    squares = alpha**2 * products.squares + (B * (gram @ B - 2.0 * alpha * correlations)).sum(axis=0)
    above: Array = np.maximum(squares, 0.0) + _rounding(B) * _reach(products, columns, alpha, B) ** 2
    return above


class GramAndCorrelations:
    """X^T X and X^T Y are known: no pass over X.

    Parameters
    ----------
    correlations : float array (n, q)
        X^T Y.
    gram : float array (n, n)
        X^T X.
    squares : float64 array (q,)
        ||y_i||^2.
    """

    def __init__(self, correlations: NDArray[Any], gram: NDArray[Any], squares: Array) -> None:
        if gram.shape != (correlations.shape[0],) * 2:
            raise ValueError(f"gram must have the shape {(correlations.shape[0],) * 2}, got {gram.shape}")
        self._correlations = correlations
        self._gram = gram
        self._squares = squares

    @property
    def size(self) -> int:
        """Number of template frames."""
        return int(self._correlations.shape[0])

    @property
    def squares(self) -> Array:
        """||y_i||^2, float64 (q,)."""
        return self._squares

    def guess(self) -> NDArray[np.float32]:
        """Return the known correlations."""
        return self._correlations.astype(np.float32, copy=False)

    def restricted(self, columns: Columns) -> tuple[Array, Array]:
        """Look the products up."""
        return self._gram[np.ix_(columns, columns)].astype(np.float64), self._correlations[columns].astype(np.float64)

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Combine columns of X^T X; it is symmetric, and its rows are contiguous."""
        rows, correlations = self._gram[dual.columns].astype(np.float32, copy=False), self._correlations
        if columns is not None:
            rows, correlations = rows[:, columns], correlations[columns]
        known = correlations.astype(np.float32, copy=False) * dual.alpha.astype(np.float32)
        values = known - rows.T @ dual.B.astype(np.float32)
        if not np.isfinite(values).all():
            raise ValueError("gram contains NaN or infinity, or overflows float32 products")
        # |c| |alpha| + sum |g| |B| bounds every partial sum; |g| <= ||x_r|| ||x_s||.
        longest = np.sqrt(self._gram.diagonal()[dual.columns].max(initial=0.0))
        reach = np.abs(dual.B).sum(axis=0) * longest + np.sqrt(self._squares) * dual.alpha
        lengths = self.lengths() if columns is None else self.lengths()[columns]
        return Gradients(values, lengths * (rounding(dual.columns.size + 3) * float(np.linalg.norm(reach))))

    def exact_gradients(self, dual: DualPoint, columns: Columns) -> Array:
        """Combine in float64."""
        gram = self._gram[np.ix_(columns, dual.columns)].astype(np.float64)
        exact: Array = self._correlations[columns] * dual.alpha - gram @ dual.B
        return exact

    def residual_norms(self, columns: Columns, weights: Array) -> Array:
        """Combine products."""
        return np.sqrt(squared_lengths(self, columns, np.ones(weights.shape[1]), weights))

    def dual_bounds(self, dual: DualPoint) -> DualBounds:
        """Take the products as given, and bound what float64 makes of them."""
        value = (dual.alpha * self._squares).sum() - (self._correlations[dual.columns] * dual.B).sum()
        off, reach = _rounding(dual.B), _reach(self, dual.columns, dual.alpha, dual.B)
        length = np.sqrt(squared_lengths(self, dual.columns, dual.alpha, dual.B)).max()
        error = off * float(reach @ np.sqrt(self._squares))
        return DualBounds(float(value) - error, float(length), (off * float(self.lengths().max())) * reach)

    def movement(self, old: DualPoint, new: DualPoint) -> tuple[float, float] | None:
        """Gradients cost less than knowing which of them moved."""
        return None

    def lengths(self) -> Array:
        """||x_r||, float64 (n,)."""
        lengths: Array = np.sqrt(self._gram.diagonal().astype(np.float64))
        if not np.isfinite(lengths).all():
            raise ValueError("gram contains NaN or infinity, or a negative square")
        return lengths
