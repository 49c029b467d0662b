"""State matching (paper, section III-A and Algorithm 2): find the weights W that minimize Eq. 7, and a duality gap.

Both penalties separate over template sequences and most sequences get no weight. So `working_set` solves Eq. 7 on few
template frames (by `newton`), bounds from below what all others could change (`duality_gap`), adds the frames that
matter, and stops when the relative duality gap of the *full* problem is within the tolerance. The gap proves each
answer, as Eq. 14 to 17 prove the limit of Algorithm 2, whose steps are Eq. 10 to 12; as published that is in
`tests/benchmarks/recognition`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smal.arrays import AnyArray, Floats, Indices
from smal.paper.working_set import WorkingSet


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution of Eq. 7 and its duality gap, of n template and q query frames."""

    active: Indices  # (p,) template frames (rows of W) that may have a weight, ascending.
    active_weights: Floats  # (p, q) their rows of W; all other rows are zero.
    shape: tuple[int, int]  # (n, q).
    sequence_length: int
    objective: float  # Eq. 7 at W.
    duality_gap: float  # Relative: the optimum of Eq. 7 is at least objective * (1 - duality_gap), rounding included.
    iterations: int  # Newton steps in all rounds of the working set.
    converged: bool  # Whether the gap is within the tolerance that was asked for.
    residual_norms: Floats  # (q,) ||y_i - X w_i||.

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
        where = np.searchsorted(self.active_blocks, self.active // self.sequence_length)
        return np.asarray(
            np.bincount(where, np.abs(self.active_weights).sum(axis=1)), dtype=np.float64
        )

    @property
    def best_block(self) -> int | None:
        """The template sequence with the largest weight (Eq. 9); None where W is zero."""
        weights = self.block_weights
        return int(self.active_blocks[np.argmax(weights)]) if weights.size else None


def solve(
    templates: AnyArray,
    query: AnyArray,
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    tolerance: float = 1e-4,
) -> Solution:
    """Match a query sequence against template sequences: minimize Eq. 7.

    X (m, n) is taken in float32, and not copied if it is so in Fortran order; sequence j is the l columns from j l
    on, of which the last may have fewer. Y (m, q) usually has q = l. The lambdas weigh ||W||_{2,1} and ||W||_{S1},
    are not negative, and not both zero. It ends at a relative duality gap of the full problem, `tolerance`: where a
    query frame is a combination of templates its residual vanishes, and below about 1e-5 rounding may keep the gap
    from getting there, as `converged` tells. ValueError for shapes that do not fit, NaN or infinity, or parameters
    out of range.
    """
    _check(templates, query, sequence_length, lambda1, lambda2, tolerance)
    rows = np.ascontiguousarray(templates.T, dtype=np.float32)
    n = len(rows)
    q = query.shape[1]
    frames = np.ascontiguousarray(query.T, dtype=np.float64)
    lengths = np.linalg.norm(frames, axis=1)
    if not np.isfinite(lengths).all():
        raise ValueError("the query contains NaN or infinity")
    seen = np.flatnonzero(lengths > 0.0)
    if not seen.size:
        return Solution(
            np.zeros(0, np.intp),
            np.zeros((0, q)),
            (n, q),
            sequence_length,
            0.0,
            0.0,
            0,
            True,
            np.zeros(q),
        )
    found = WorkingSet(rows, frames[seen], sequence_length, lambda1, lambda2, tolerance)
    found.grow_until_proved()
    used = np.flatnonzero(found.weights.any(axis=1))
    weights = np.zeros((used.size, q))
    residuals = np.zeros(q)
    weights[:, seen] = found.weights[used]
    residuals[seen] = found.residuals
    return Solution(
        found.columns[used], weights, (n, q), sequence_length, found.objective, found.gap, found.steps,
        found.gap <= tolerance, residuals,
    )  # fmt: skip


def _check(
    X: AnyArray, Y: AnyArray, length: int, lambda1: float, lambda2: float, tolerance: float
) -> None:
    """Refuse input for which Eq. 7 or its duality gap means nothing."""
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
