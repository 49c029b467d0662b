"""State matching (paper, section III-A and Algorithm 2): find the weights W that minimize Eq. 7, and a duality gap.

Both penalties separate over template sequences, and most sequences get no weight. So `working_set` solves Eq. 7 on few
template frames (by `newton`), bounds from below the effect of all others (`duality_gap`), and adds the frames that
matter. It stops when the relative duality gap of the *full* problem is within the tolerance. The gap proves each
solution, as Eq. 14 to 17 prove the limit of Algorithm 2 (steps Eq. 10 to 12). Algorithm 2 as published is in
`tests/benchmarks/recognition`.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smal.arrays import AnyArray, Floats, Indices
from smal.paper.working_set import WorkingSet


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution of Eq. 7 and its duality gap, of n template and q query frames."""

    #: (p,) template frames (rows of W) that can have a weight, ascending.
    active: Indices
    #: (p, q) their rows of W; all other rows are zero.
    active_weights: Floats
    #: (n, q).
    shape: tuple[int, int]
    sequence_length: int
    #: Eq. 7 at W.
    objective: float
    #: Relative: the optimum of Eq. 7 is at least objective * (1 - duality_gap), rounding included.
    duality_gap: float
    #: Newton steps in all rounds of the working set.
    iterations: int
    #: Whether the gap is within the requested tolerance.
    converged: bool
    #: (q,) ||y_i - X w_i||.
    residual_norms: Floats

    @property
    def weights(self) -> Floats:
        """W, float64 (n, q)."""
        weights = np.zeros(self.shape)
        weights[self.active] = self.active_weights
        return weights

    @cached_property
    def active_blocks(self) -> Indices:
        """Template sequences with weight, ascending (b,)."""
        return np.unique(self.active // self.sequence_length)

    @cached_property
    def block_weights(self) -> Floats:
        """Weight of each of them, sum_i ||w_i^j||_1 (left side of Eq. 8), (b,)."""
        blocks = self.active // self.sequence_length
        where = np.searchsorted(self.active_blocks, blocks)
        weights = np.abs(self.active_weights).sum(axis=1)
        return np.asarray(np.bincount(where, weights), dtype=np.float64)

    @property
    def best_block(self) -> int | None:
        """The template sequence with the largest weight (Eq. 9); None if W is zero."""
        weights = self.block_weights
        return int(self.active_blocks[np.argmax(weights)]) if weights.size else None


def usual_lambda(length: int) -> float:
    """Return the usual lambda1 and lambda2, 0.1 sqrt(l): an active row or column of W has about l entries."""
    return 0.1 * math.sqrt(length)


def solve(
    templates: AnyArray,
    query: AnyArray,
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    tolerance: float = 1e-4,
) -> Solution:
    """Match a query sequence against template sequences: minimize Eq. 7.

    Parameters
    ----------
    templates : array (m, n)
        X. Sequence j is the l columns from j l on; the last sequence can be shorter. It is converted to float32; an
        array of float32 in Fortran order is not copied.
    query : array (m, q)
        Y, usually with q = l.
    sequence_length : int
        l.
    lambda1, lambda2 : float
        Weights of ||W||_{2,1} and ||W||_{S1}, not negative, and not both zero.
    tolerance : float
        Relative duality gap of the full problem. If a query frame is a combination of templates, its residual is zero.
        Then rounding can prevent a gap below about 1e-5, and `converged` is False.

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, or parameters are out of range.
    """
    _check(templates, query, sequence_length, lambda1, lambda2, tolerance)
    rows = np.ascontiguousarray(templates.T, dtype=np.float32)
    n = len(rows)
    q = query.shape[1]
    frames = np.ascontiguousarray(query.T, dtype=np.float64)
    lengths = np.linalg.norm(frames, axis=1)
    if not np.isfinite(lengths).all():
        raise ValueError("the query contains NaN or infinity")
    nonzero = np.flatnonzero(lengths > 0.0)
    if not nonzero.size:
        return Solution(
            active=np.zeros(0, np.intp),
            active_weights=np.zeros((0, q)),
            shape=(n, q),
            sequence_length=sequence_length,
            objective=0.0,
            duality_gap=0.0,
            iterations=0,
            converged=True,
            residual_norms=np.zeros(q),
        )
    found = WorkingSet(rows, frames[nonzero], sequence_length, lambda1, lambda2, tolerance)
    found.grow_until_proved()
    used = np.flatnonzero(found.weights.any(axis=1))
    weights = np.zeros((used.size, q))
    residuals = np.zeros(q)
    weights[:, nonzero] = found.weights[used]
    residuals[nonzero] = found.residuals
    return Solution(
        active=found.columns[used],
        active_weights=weights,
        shape=(n, q),
        sequence_length=sequence_length,
        objective=found.objective,
        duality_gap=found.gap,
        iterations=found.steps,
        converged=found.gap <= tolerance,
        residual_norms=residuals,
    )


def _check(
    X: AnyArray, Y: AnyArray, length: int, lambda1: float, lambda2: float, tolerance: float
) -> None:
    """Raise ValueError for input for which Eq. 7 or its duality gap is undefined."""
    if X.ndim != 2 or not np.issubdtype(X.dtype, np.floating):
        raise ValueError(
            f"templates must be a floating point matrix (m, n), got {X.dtype} {X.shape}"
        )
    if Y.ndim != 2 or X.shape[0] != Y.shape[0]:
        raise ValueError(f"templates (m, n) and query (m, q) do not fit: {X.shape} and {Y.shape}")
    if not (np.issubdtype(Y.dtype, np.floating) or np.issubdtype(Y.dtype, np.integer)):
        raise ValueError(f"the query must be real numbers, got {Y.dtype}")
    if X.shape[1] < 1:
        raise ValueError("matching needs at least one template")
    if length < 1:
        raise ValueError(f"sequence_length must be at least 1, got {length}")
    if not (
        np.isfinite([lambda1, lambda2]).all()
        and min(lambda1, lambda2) >= 0.0
        and lambda1 + lambda2 > 0.0
    ):
        raise ValueError(
            f"lambda1 and lambda2 must be finite, not negative and not both 0, got {lambda1}, {lambda2}"
        )
    if not 1e-8 <= tolerance < 1.0:
        raise ValueError(f"tolerance must be at least 1e-8 and below 1, got {tolerance}")
