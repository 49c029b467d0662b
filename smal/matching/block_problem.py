"""Eq. 7 on few template frames, in terms of inner products, and its norms smoothed."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled

Array = NDArray[np.float64]

_GAP_TO_EPSILON = 0.7
# Squared residuals below this share of the query are rounding.
_ROUNDING = 1e-15


class BlockProblem(NamedTuple):
    """Eq. 7 restricted to p template frames of b sequences, in terms of inner products.

    Parameters
    ----------
    gram : float64 array (p, p)
        X^T X.
    correlations : float64 array (p, q)
        X^T Y.
    squares : float64 array (q,)
        ||y_i||^2, all positive.
    lambda1, lambda2 : float
    starts : intp array (b + 1,)
        Sequence j has the rows starts[j] to starts[j + 1].
    """

    gram: Array
    correlations: Array
    squares: Array
    lambda1: float
    lambda2: float
    starts: NDArray[np.intp]


class Primal(NamedTuple):
    """W, X^T X W, and the squares of all norms in Eq. 7."""

    W: Array
    products: Array
    squared_residuals: Array
    squared_rows: Array
    squared_columns: Array


@compiled
def dots(left: Array, right: Array) -> Array:
    """<left_i, right_i> for every column i."""
    sums = np.zeros(left.shape[1])
    for r in range(left.shape[0]):
        for i in range(left.shape[1]):
            sums[i] += left[r, i] * right[r, i]
    return sums


@compiled
def measure(problem: BlockProblem, W: Array, products: Array) -> Primal:
    """Find all norms of Eq. 7 at W, given X^T X W."""
    p, q = W.shape
    rows, columns = np.zeros(p), np.zeros((problem.starts.size - 1, q))
    residuals = problem.squares.copy()
    for j in range(problem.starts.size - 1):
        for r in range(problem.starts[j], problem.starts[j + 1]):
            for i in range(q):
                residuals[i] -= W[r, i] * (2.0 * problem.correlations[r, i] - products[r, i])
                square = W[r, i] * W[r, i]
                rows[r] += square
                columns[j, i] += square
    return Primal(W, products, np.maximum(residuals, _ROUNDING * problem.squares), rows, columns)


@compiled
def smoothed(primal: Primal, epsilon: float) -> tuple[Array, Array, Array]:
    """Return the norms of residuals (q,), rows (p,) and columns of blocks (b, q), smoothed by epsilon."""
    square = epsilon * epsilon
    return (
        np.sqrt(primal.squared_residuals + square),
        np.sqrt(primal.squared_rows + square),
        np.sqrt(primal.squared_columns + square),
    )


@compiled
def smoothed_objective(problem: BlockProblem, primal: Primal, epsilon: float) -> float:
    """Eq. 7, every norm smoothed by epsilon."""
    d, e, f = smoothed(primal, epsilon)
    value: float = d.sum() + problem.lambda1 * e.sum() + problem.lambda2 * f.sum()
    return value


@compiled
def smoothing_for(problem: BlockProblem, excess: float) -> float:
    """Return the epsilon that costs about as much as the excess of the objective: 0.3 epsilon per norm, doubled."""
    p, q = problem.correlations.shape
    norms = q + problem.lambda1 * p + problem.lambda2 * q * (problem.starts.size - 1)
    epsilon: float = _GAP_TO_EPSILON * excess / norms
    return epsilon


@compiled
def block_objective(problem: BlockProblem, weights: Array) -> float:
    """Eq. 7 at the weights (p, q)."""
    return smoothed_objective(problem, measure(problem, weights, np.dot(problem.gram, weights)), 0.0)
