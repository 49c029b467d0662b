"""The inner solver of ordered matching: a few sequences, compiled.

Sequences are given by their inner products only, frame by frame, so that nothing here is as long as a feature vector.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.paper.compiled import compiled

#: A residual shorter than this (frames have length 1) is rounding noise: its square is the difference of float32
#: products, which are off by 1e-7. The dual point r / max(||r||, floor) stays feasible below it.
FLOOR: Final = 5e-4
#: A sequence with less curvature than this shows nothing.
_FLAT: Final = 1e-9
#: Weights that change by less do not change.
_STILL: Final = 1e-8
#: Parabolas in a row for one working set.
_MOST_STEPS: Final = 1000


@compiled
def gather(
    gram: NDArray[np.float32], products: NDArray[np.float32], frames: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Take out the inner products of p sequences frame by frame, (l, p, p), and those with the query, (l, p)."""
    count, length = frames.shape
    blocks, linear = np.empty((length, count, count)), np.empty((length, count))
    for i in range(length):
        for a in range(count):
            row = gram[frames[a, i]]
            linear[i, a] = products[i, frames[a, i]]
            for b in range(count):
                blocks[i, a, b] = row[frames[b, i]]
    return blocks, linear


@compiled
def combine(
    gram: NDArray[np.float32],
    frames: NDArray[np.int64],
    weights: NDArray[np.float32],
    explained: NDArray[np.float32],
) -> None:
    """Compute the products of all references with sum_j c_j x_{j,i}, (l, n)."""
    explained[:] = 0.0
    for i in range(explained.shape[0]):
        for a in range(frames.shape[0]):
            row, weight = gram[frames[a, i]], weights[a]
            for reference in range(explained.shape[1]):
                explained[i, reference] += weight * row[reference]


@compiled
def minimize(
    blocks: NDArray[np.float64],
    linear: NDArray[np.float64],
    squares: NDArray[np.float64],
    penalties: NDArray[np.float64],
    weights: NDArray[np.float64],
    residuals: NDArray[np.float64],
    tolerance: float,
) -> None:
    """Solve the program over p sequences, from `weights`, in place.

    Each residual norm is majorised by the parabola that touches it (as in Algorithm 2), and the parabolas' sum is
    minimized by cyclic coordinate descent; the objective falls in every round.
    """
    length, count = linear.shape
    curvature, slope = np.empty((count, count)), np.empty(count)
    gradient = np.empty(count)
    _residual_norms(blocks, linear, squares, weights, residuals)
    for _ in range(_MOST_STEPS):
        curvature[:] = 0.0
        slope[:] = 0.0
        for i in range(length):
            scale = 1.0 / (length * max(residuals[i], FLOOR))
            curvature += scale * blocks[i]
            slope += scale * linear[i]
        gradient[:] = slope - curvature @ weights - penalties
        # The majoriser touches the objective here, so their duality gaps agree.
        primal, reached, worst = penalties @ weights, 0.0, 1.0
        for i in range(length):
            primal += residuals[i] / length
            reached += (squares[i] - linear[i] @ weights) / (length * max(residuals[i], FLOOR))
        for a in range(count):
            price = gradient[a] + penalties[a]
            if price > penalties[a]:
                worst = min(worst, penalties[a] / price)
        if primal - worst * reached <= tolerance * primal:
            return
        moved = _descend(curvature, gradient, weights)
        # The certificate is of the last weights, whether or not they are good enough.
        _residual_norms(blocks, linear, squares, weights, residuals)
        if moved < _STILL:
            return


@compiled
def _descend(curvature: NDArray[np.float64], gradient: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Minimize 1/2 c'Hc - g'c over c >= 0 by cyclic coordinate descent; `gradient` is g - Hc and kept so.

    Returns the largest step of the first sweep, which is small where the weights were good already.
    """
    count, first = weights.size, 0.0
    for sweep in range(100):
        moved = 0.0
        for a in range(count):
            if curvature[a, a] <= _FLAT:
                continue
            step = max(gradient[a] / curvature[a, a], -weights[a])
            if step != 0.0:
                weights[a] += step
                for b in range(count):
                    gradient[b] -= step * curvature[a, b]
                moved = max(moved, abs(step))
        if sweep == 0:
            first = moved
        if moved < _STILL:
            break
    return first


@compiled
def _residual_norms(
    blocks: NDArray[np.float64],
    linear: NDArray[np.float64],
    squares: NDArray[np.float64],
    weights: NDArray[np.float64],
    residuals: NDArray[np.float64],
) -> None:
    for i in range(residuals.size):
        square = squares[i] - 2.0 * (linear[i] @ weights) + weights @ (blocks[i] @ weights)
        residuals[i] = np.sqrt(max(square, 0.0))
