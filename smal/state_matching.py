"""State matching (paper, section III-A and Algorithm 2): find the weights W that minimise Eq. 7, with a certificate.

Both penalties separate over template sequences and most sequences get no weight. So we solve Eq. 7 on a working
set of few sequences, extend its dual point to all of them, add the sequences that violate it, and stop when the
relative duality gap of the *full* problem is within the tolerance; how is in `smal.matching`. Algorithm 2 as published
is in `smal.algorithm2`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.inner_products import Columns, GramAndCorrelations, InnerProducts
from smal.matching.screening import Penalty
from smal.matching.template_index import IndexAndQuery, TemplateIndex
from smal.matching.template_products import TemplatesAndQuery
from smal.matching.working_set import minimise

Array = NDArray[np.float64]

# Products in float32 cannot tell a residual below 1e-3 of the query from zero (its square is 1e-6).
_FLOAT32_SQUARE = 1e-6


@dataclass(frozen=True, eq=False)
class Solution:
    """A certified solution of Eq. 7.

    Parameters
    ----------
    active : intp array (p,)
        Template frames (rows of W) that may have a weight, ascending.
    active_weights : float64 array (p, q)
        Their rows of W; all other rows are zero.
    shape : (n, q)
    sequence_length : int
    objective : float
        Eq. 7 at W.
    duality_gap : float
        Relative: the optimum of Eq. 7 is at least objective * (1 - duality_gap), rounding included
        (`solve_from_correlations`: save that of the products it is given).
    iterations : int
        Newton steps in all rounds of the working set.
    converged : bool
        Whether the gap is within the tolerance that was asked for.
    residual_norms : float64 array (q,)
        ||y_i - X w_i||.
    """

    active: Columns
    active_weights: Array
    shape: tuple[int, int]
    sequence_length: int
    objective: float
    duality_gap: float
    iterations: int
    converged: bool
    residual_norms: Array

    @property
    def weights(self) -> Array:
        """W, float64 (n, q)."""
        weights = np.zeros(self.shape)
        weights[self.active] = self.active_weights
        return weights

    @cached_property
    def active_blocks(self) -> Columns:
        """Template sequences with weight, ascending (b,)."""
        return np.unique(self.active // self.sequence_length)

    @cached_property
    def block_weights(self) -> Array:
        """Weight of each of them, sum_i ||w_i^j||_1 (left side of Eq. 8), (b,)."""
        where = np.searchsorted(self.active_blocks, self.active // self.sequence_length)
        return np.asarray(np.bincount(where, np.abs(self.active_weights).sum(axis=1)), dtype=np.float64)

    @property
    def best_block(self) -> int | None:
        """The template sequence with the largest weight (Eq. 9); None where W is zero."""
        weights = self.block_weights
        return int(self.active_blocks[np.argmax(weights)]) if weights.size else None


def check_parameters(n: int, sequence_length: int, lambda1: float, lambda2: float, tolerance: float) -> None:
    """Refuse parameters for which Eq. 7 or its certificate means nothing."""
    if n < 1:
        raise ValueError("matching needs at least one template")
    if sequence_length < 1:
        raise ValueError(f"sequence_length must be at least 1, got {sequence_length}")
    if not (np.isfinite([lambda1, lambda2]).all() and min(lambda1, lambda2) >= 0.0 and lambda1 + lambda2 > 0.0):
        raise ValueError(f"lambda1 and lambda2 must be finite, not negative and not both 0, got {lambda1}, {lambda2}")
    if not 1e-8 <= tolerance < 1.0:
        raise ValueError(f"tolerance must be at least 1e-8 and below 1, got {tolerance}")


def match(products: InnerProducts, seen: Columns, q: int, penalty: Penalty, warm_start: Solution | None) -> Solution:
    """Match in terms of inner products (`solve` and its siblings choose them).

    Parameters
    ----------
    products : InnerProducts
        Of the templates and the query frames that are not zero; the others have the weights zero.
    seen : intp array
        Which query frames those are.
    q : int
        Query frames in all.
    penalty : Penalty
    warm_start : Solution, optional
        Of a similar query: its sequences enter the working set at once. Changes the time, not the answer.
    """
    n, length = products.size, penalty.sequence_length
    if not seen.size:
        return Solution(np.zeros(0, np.intp), np.zeros((0, q)), (n, q), length, 0.0, 0.0, 0, True, np.zeros(q))
    warm = warm_start.active_blocks if warm_start is not None else np.zeros(0, dtype=np.intp)
    found = minimise(products, penalty, warm[warm * length < n])
    used = np.flatnonzero(found.weights.any(axis=1))
    weights, residuals = np.zeros((used.size, q)), np.zeros(q)
    weights[:, seen], residuals[seen] = found.weights[used], found.residual_norms
    converged = found.gap <= penalty.tolerance
    return Solution(
        found.columns[used], weights, (n, q), length, found.objective, found.gap, found.steps, converged, residuals
    )


def solve(
    templates: NDArray[Any] | TemplateIndex,
    query: NDArray[Any],
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    tolerance: float = 1e-4,
    gram: NDArray[Any] | None = None,
) -> Solution:
    """Match a query sequence against template sequences: minimise Eq. 7.

    Parameters
    ----------
    templates : float array (m, n) or TemplateIndex
        X. Sequence j is the columns j * sequence_length and following; the last one may be shorter. Float32 in
        Fortran order (a template contiguous) is fastest. C order is not copied, but takes about twice as long: for
        many queries prepare X once, by `np.asfortranarray` or as an index, which pays from the second query on.
    query : float array (m, q)
        Y, usually with q = sequence_length.
    sequence_length : int
        l, at least 1.
    lambda1, lambda2 : float
        Weights of ||W||_{2,1} and ||W||_{S1}; not negative, not both zero.
    tolerance : float
        Relative duality gap at which to stop. Where a query frame is a combination of templates, its residual
        vanishes, and below about 1e-5 rounding may keep the gap from getting there; `converged` tells.
    gram : float array (n, n), optional
        X^T X if it is known; in float64, or residuals near zero are not found. The gap holds whatever it is.

    Returns
    -------
    Solution
        Its gap holds for the full problem.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, or parameters out of range.
    """
    if len(templates.shape) != 2 or query.ndim != 2 or templates.shape[0] != query.shape[0]:
        raise ValueError(f"templates (m, n) and query (m, q) do not fit: {templates.shape} and {query.shape}")
    if not isinstance(templates, TemplateIndex) and not np.issubdtype(templates.dtype, np.floating):
        raise ValueError(f"templates must be floating point, got {templates.dtype}")
    check_parameters(templates.shape[1], sequence_length, lambda1, lambda2, tolerance)
    if gram is not None and gram.shape != (templates.shape[1],) * 2:
        raise ValueError(f"gram must have the shape {(templates.shape[1],) * 2}, got {gram.shape}")
    if not (np.issubdtype(query.dtype, np.floating) or np.issubdtype(query.dtype, np.integer)):
        raise ValueError(f"the query must be real numbers, got {query.dtype}")
    if isinstance(templates, np.ndarray) and templates.dtype.itemsize < 4:
        templates = templates.astype(np.float32)
    Y = np.asarray(query, dtype=np.float64)
    squares = np.square(Y).sum(axis=0)
    if not np.isfinite(squares).all():
        raise ValueError("the query contains NaN or infinity")
    seen = np.flatnonzero(squares > 0.0)
    products: InnerProducts
    if isinstance(templates, TemplateIndex):
        products = IndexAndQuery(templates, Y[:, seen], gram)
    else:
        products = TemplatesAndQuery(templates, Y[:, seen], gram)
    return match(products, seen, Y.shape[1], Penalty(sequence_length, lambda1, lambda2, tolerance), None)


def solve_from_correlations(
    correlations: NDArray[Any],
    gram: NDArray[Any],
    query_norms: NDArray[Any],
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    tolerance: float = 1e-4,
    warm_start: Solution | None = None,
) -> Solution:
    """Match when X^T Y and X^T X are known already.

    Parameters
    ----------
    correlations : float array (n, q)
        X^T Y.
    gram : float array (n, n)
        X^T X.
    query_norms : float array (q,)
        ||y_i||.
    sequence_length, lambda1, lambda2, tolerance
        As in `solve`.
    warm_start : Solution, optional
        Of a similar query: its sequences enter the working set at once. Changes the time, not the answer.

    Returns
    -------
    Solution
        Of Eq. 7 with every query frame given a component of 1e-3 of its length orthogonal to all templates,
        since products in float32 cannot tell smaller residuals from zero: objective and gap are those of that
        problem, whose optimum is at most 1e-3 * sum ||y_i|| above the other one. They take correlations and gram as
        exact: what these lost in rounding, in float32 above all, is not in the gap.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, or parameters out of range.
    """
    if correlations.ndim != 2 or query_norms.shape != (correlations.shape[1],):
        raise ValueError(f"correlations (n, q) and norms (q,) do not fit: {correlations.shape}, {query_norms.shape}")
    check_parameters(correlations.shape[0], sequence_length, lambda1, lambda2, tolerance)
    squares = np.square(query_norms, dtype=np.float64) * (1.0 + _FLOAT32_SQUARE)
    if not (np.isfinite(squares).all() and np.isfinite(correlations).all()):
        raise ValueError("correlations or norms contain NaN or infinity")
    seen = np.flatnonzero(squares > 0.0)
    products = GramAndCorrelations(correlations[:, seen], gram, squares[seen])
    penalty = Penalty(sequence_length, lambda1, lambda2, tolerance)
    return match(products, seen, query_norms.size, penalty, warm_start)
