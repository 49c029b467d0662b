"""Matching a query sequence in the order of its frames: Eq. 7 with sequences that are matched frame by frame.

Eq. 7 lets every frame of a template sequence explain every frame of the query: its S1-norm groups frames and does not
know their order. On real pictures order is what tells places apart. So let the block of W that
belongs to sequence j be diagonal, W^j = c_j I: the i-th query frame is explained by the i-th frame of the sequence.
Both penalties of Eq. 7 are then the same norm, l sum_j c_j, with lambda = lambda1 + lambda2, and what remains is

    min_{c >= 0}  1/l sum_i || y_i - sum_j c_j x_{j,i} ||_2  +  sum_j lambda_j c_j ,

convex as before and with as many unknowns as sequences. Its loss is the paper's, by which a frame that nothing
explains (an occluded one) counts once and not squared. Its dual is

    max_theta  1/l sum_i theta_i . y_i   with  ||theta_i|| <= 1  and  1/l sum_i x_{j,i} . theta_i <= lambda_j for all j,

so that the residuals, scaled until they are feasible, bound the optimum over all sequences. The left side of the
constraint is a sum along the sequence: one pass over the products of residuals and references prices all of them.

The paper cuts templates at fixed phases; here a sequence ends at any reference, and advances at any of some speeds.
Sequences are known by inner products only, so that nothing here is as long as a feature vector.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from smal.place_recognition.trajectories import steps_back, sums_along

Array = NDArray[np.float64]

#: Reference frames to one query frame, in quarters of an octave from half to twice.
SPEEDS: Final = tuple(2.0 ** (step / 4) for step in range(-4, 5))
#: A residual shorter than this (frames have length 1) is rounding noise: its square is the difference of float32
#: products, which are off by 1e-7. The dual point r / max(||r||, floor) stays feasible below it.
FLOOR: Final = 5e-4
#: Sequences that the first working set holds, and that a later round adds at most.
_FIRST: Final = 24
_MORE: Final = 12
_MOST_ROUNDS: Final = 30
#: Parabolas in a row for one working set; weights that change by less do not change.
_MOST_STEPS: Final = 1000
_STILL: Final = 1e-8
#: Share of the largest curvature that is added to all: sequences may repeat.
_RIDGE: Final = 1e-11


@dataclass(frozen=True, eq=False)
class OrderedSolution:
    """The global optimum, as far as its duality gap says.

    Parameters
    ----------
    sequences : int64 array (p,)
        Sequences with weight: v n + e has speed number v and ends at reference e.
    weights : float64 array (p,)
        c, above 0.
    objective : float
    duality_gap : float
        At most this much is the objective above the optimum, relative to itself; to the rounding of the float32
        products, some 1e-7 / (||r|| lambda) with r the shortest residual. Above the tolerance where the products are
        not precise enough: a query that is a copy of its references is certified to about 1e-3.
    penalty : float
        lambda.
    """

    sequences: NDArray[np.int64]
    weights: Array
    objective: float
    duality_gap: float
    penalty: float


def solve_ordered(
    products: NDArray[np.float32],
    norms: Array,
    gram: NDArray[np.float32],
    speeds: tuple[float, ...],
    surcharge: Array,
    relative_penalty: float,
    tolerance: float = 1e-3,
) -> OrderedSolution:
    """Solve the program above for one query sequence.

    Parameters
    ----------
    products : float32 array (l, n)
        x_a . y_i of every query frame with every reference.
    norms : float64 array (l,)
        ||y_i||; a frame of norm 0 shows nothing and explains nothing.
    gram : float32 array (n, n)
        x_a . x_b.
    speeds : tuple of float
        v, reference frames to one query frame, positive. Sequence (v, e) has the frames e - round(v (l - 1 - i)),
        i = 0..l-1; it exists where the first of them does.
    surcharge : float64 array (speeds,)
        What a sequence of that speed is penalized beyond lambda, at least 0.
    relative_penalty : float
        lambda as a share, above 0 and below 1, of the smallest one for which c = 0.
    tolerance : float
        Relative duality gap at which to stop.

    Returns
    -------
    OrderedSolution
        Without sequences where none is alike in the least.
    """
    (length, n), squares = products.shape, np.square(norms)
    steps = steps_back(speeds, length)
    scale = np.divide(1.0, norms, out=np.zeros(norms.shape), where=norms > FLOOR)
    excess = _prices(products, scale, steps) - surcharge[:, None]
    penalty = relative_penalty * float(excess.max(initial=-np.inf))
    if not penalty > 0.0:
        return OrderedSolution(np.empty(0, dtype=np.int64), np.empty(0), float(norms.mean()), 0.0, 0.0)
    penalties = penalty + surcharge
    working = _largest(excess.ravel(), _FIRST)
    weights = np.zeros(working.size)
    turn = 0
    while True:
        turn += 1
        speed, end = np.divmod(working, n)
        frames = end - steps[speed, ::-1].T
        blocks = gram[frames[:, :, None], frames[:, None, :]].astype(np.float64)
        linear = products[np.arange(length)[:, None], frames].astype(np.float64)
        weights, residuals = _minimize(blocks, linear, squares, penalties[speed], weights, 0.1 * tolerance)
        active = np.flatnonzero(weights)
        explained = np.einsum("ian,a->in", gram[frames[:, active]], weights[active].astype(np.float32))
        prices = _prices(products - explained, 1.0 / np.maximum(residuals, FLOOR), steps)
        primal = float(residuals.mean() + penalties[speed] @ weights)
        agreement = float(((squares - linear @ weights) / np.maximum(residuals, FLOOR)).mean())
        gap = 1.0 - _feasible(penalties, prices.max(axis=1)) * agreement / primal
        excess = (prices - penalties[:, None]).ravel()
        excess[working] = -np.inf
        lacking = _largest(excess, _MORE)
        lacking = lacking[excess[lacking] > 0.0]
        if gap <= tolerance or not lacking.size or turn == _MOST_ROUNDS:
            return OrderedSolution(working[active], weights[active], primal, max(gap, 0.0), penalty)
        # What has no weight after the first round rarely gets some: a small problem is a fast one.
        working, weights = np.append(working[active], lacking), np.append(weights[active], np.zeros(lacking.size))


def _prices(products: NDArray[np.float32], scale: Array, steps: NDArray[np.int64]) -> Array:
    """Average products (l, n), each frame scaled, along every sequence; -inf where there is none: (speeds, n)."""
    scaled = products * scale[:, None].astype(np.float32)
    prices = np.full((len(steps), products.shape[1]), -np.inf)
    for price, back in zip(prices, steps, strict=True):
        price[back[-1] :] = sums_along(scaled, back)[0] / np.float32(len(products))
    return prices


def _feasible(limits: Array, prices: Array) -> float:
    """Return by how much the dual point is to be scaled so that no price exceeds its limit."""
    return float(np.divide(limits, prices, out=np.ones(limits.shape), where=prices > limits).min(initial=1.0))


def _largest(values: Array, count: int) -> NDArray[np.int64]:
    """Return where the largest finite values are."""
    count = min(count, values.size)
    where = np.argpartition(-values, count - 1)[:count]
    found: NDArray[np.int64] = where[np.isfinite(values[where])]
    return found


def _minimize(
    blocks: Array, linear: Array, squares: Array, penalties: Array, weights: Array, tolerance: float
) -> tuple[Array, Array]:
    """Solve the program over p sequences, from some weights: weights (p,) and residual norms (l,).

    Each residual norm is majorised by the parabola that touches it (as in Algorithm 2), and the parabolas' sum is
    minimized as non-negative least squares; the objective falls in every round.

    Parameters
    ----------
    blocks, linear : float64 arrays (l, p, p), (l, p)
        Inner products of the sequences with each other and with the query, frame by frame.
    squares : float64 array (l,)
        ||y_i||^2.
    """
    residuals = _residual_norms(blocks, linear, squares, weights)
    for _ in range(_MOST_STEPS):
        scale = 1.0 / (len(linear) * np.maximum(residuals, FLOOR))
        curvature, slope = np.tensordot(scale, blocks, 1), scale @ linear
        # The majoriser touches the objective here, so their duality gaps agree.
        primal = penalties @ weights + residuals.mean()
        reached = scale @ (squares - linear @ weights)
        if primal - _feasible(penalties, slope - curvature @ weights) * reached <= tolerance * primal:
            break
        before, weights = weights, _least_squares(curvature, slope - penalties)
        residuals = _residual_norms(blocks, linear, squares, weights)
        if np.abs(weights - before).max() < _STILL:
            break
    return weights, residuals


def _least_squares(curvature: Array, slope: Array) -> Array:
    """Minimize 1/2 c'Hc - g'c over c >= 0."""
    diagonal = np.arange(len(slope))
    curvature[diagonal, diagonal] += _RIDGE * curvature.max()
    try:
        root = np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        curvature[diagonal, diagonal] += 1e-7 * curvature.max()
        root = np.linalg.cholesky(curvature)
    weights: Array = nnls(root.T, solve_triangular(root, slope, lower=True))[0]
    return weights


def _residual_norms(blocks: Array, linear: Array, squares: Array, weights: Array) -> Array:
    norms: Array = np.sqrt(np.maximum(squares - 2.0 * (linear @ weights) + (blocks @ weights) @ weights, 0.0))
    return norms
