"""Algorithm 2 of the paper as published: the reference that `smal.paper.state_matching` is compared with.

Each iteration solves l dense systems of all n templates. Its update divides by norms of residuals, rows and columns
that become zero, which the paper leaves open; here no divisor is smaller than a floor. The floor bounds how close to
zero a weight can come, and with it how close to the optimum the result is; it has no duality gap.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.paper.objective import objective

Array = NDArray[np.float64]


class ReferenceResult(NamedTuple):
    """W (n, q), Eq. 7 after every iteration, and whether the last one changed it by less than the tolerance."""

    weights: Array
    objectives: tuple[float, ...]
    converged: bool


def algorithm2(
    templates: NDArray[Any],
    query: NDArray[Any],
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
    floor: float = 1e-8,
) -> ReferenceResult:
    """Minimize Eq. 7 by reweighted least squares, for X (m, n) and Y (m, q).

    Parameters
    ----------
    lambda1, lambda2 : float
        Positive, or the systems may be singular.
    tolerance : float
        Relative change of the objective at which to stop.
    floor : float
        Smallest norm that is divided by.
    """
    X = np.asarray(templates, dtype=np.float64)
    Y = np.asarray(query, dtype=np.float64)
    gram = X.T @ X
    correlations = X.T @ Y
    # The paper does not say where to start; from W = 0 every weight would stay at the floor.
    W = np.asarray(
        np.linalg.solve(gram + (lambda1 + lambda2) * np.eye(len(gram)), correlations),
        dtype=np.float64,
    )
    objectives: list[float] = []
    for _ in range(max_iterations):
        residual_norms = np.linalg.norm(Y - X @ W, axis=0)
        W = _iterate(
            gram, correlations, residual_norms, W, sequence_length, lambda1, lambda2, floor
        )
        objectives.append(objective(X, Y, W, sequence_length, lambda1, lambda2))
        if (
            len(objectives) > 1
            and abs(objectives[-2] - objectives[-1]) <= tolerance * objectives[-1]
        ):
            return ReferenceResult(W, tuple(objectives), converged=True)
    return ReferenceResult(W, tuple(objectives), converged=False)


def _iterate(
    gram: Array,
    correlations: Array,
    residual_norms: Array,
    weights: Array,
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    floor: float,
) -> Array:
    """Lines 3 to 6 of Algorithm 2; the update is Eq. 12."""
    P = 0.5 / np.maximum(residual_norms, floor)
    Q = 0.5 / np.maximum(np.linalg.norm(weights, axis=1), floor)
    starts = np.arange(0, len(weights), sequence_length)
    of_block = np.arange(len(weights)) // sequence_length
    R = 0.5 / np.maximum(np.sqrt(np.add.reduceat(weights**2, starts, axis=0)), floor)
    updated = np.empty_like(weights)
    for i, p in enumerate(P):
        system = p * gram + np.diag(lambda1 * Q + lambda2 * R[of_block, i])
        updated[:, i] = p * np.linalg.solve(system, correlations[:, i])
    return updated
