"""Matching a query sequence in the order of its frames: Eq. 7 with sequences that are matched frame by frame.

Eq. 7 lets every frame of a template sequence explain every frame of the query: its S1-norm groups frames and does not
know their order. On real pictures order is what tells places apart. So let the block of W that
belongs to sequence j be diagonal, W^j = c_j I: the i-th query frame is explained by the i-th frame of the sequence.
Both penalties of Eq. 7 are then the same norm, l sum_j c_j, with lambda = lambda1 + lambda2, and what remains is

    min_{c >= 0}  1/l sum_i || y_i - sum_j c_j x_{j,i} ||_2  +  sum_j lambda_j c_j ,

convex as before and with as many unknowns as sequences. Its loss is the paper's, by which a frame that nothing
explains (an occluded one) counts once and not squared. Its dual is

    max_theta  1/l sum_i theta_i . y_i   with  ||theta_i|| <= 1  and  1/l sum_i x_{j,i} . theta_i <= lambda_j for all j,

so that the residuals, scaled until they are feasible, certify every answer over all sequences. The left side of the
constraint is a sum along the sequence: one pass over the products of residuals and references prices all of them.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.ordered_descent import FLOOR, combine, gather, minimize
from smal.place_recognition.template_sequences import TemplateSequences

#: Sequences that the first working set holds, and that a later round adds at most.
_FIRST: Final = 48
_MORE: Final = 24
_MOST_ROUNDS: Final = 30


@dataclass(frozen=True, eq=False)
class OrderedSolution:
    """The global optimum, as far as its certificate says.

    Parameters
    ----------
    sequences : int64 array (p,)
        Sequences with weight, numbered as in `TemplateSequences.frames`.
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
    weights: NDArray[np.float64]
    objective: float
    duality_gap: float
    penalty: float


def solve_ordered(
    products: NDArray[np.float32],
    norms: NDArray[np.float64],
    gram: NDArray[np.float32],
    template_sequences: TemplateSequences,
    surcharge: NDArray[np.float64],
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
    template_sequences : TemplateSequences
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
    seen = norms > FLOOR
    scale = np.divide(1.0, norms, out=np.zeros(norms.shape), where=seen)
    prices = template_sequences.means(products * scale[:, np.newaxis].astype(np.float32))
    reduced = prices - surcharge[:, np.newaxis].astype(np.float32)
    largest = float(reduced.max(initial=-np.inf))
    loss = float(norms.mean())
    if not largest > 0.0:
        return OrderedSolution(np.empty(0, dtype=np.int64), np.empty(0), loss, 0.0, max(largest, 0.0))
    penalty = relative_penalty * largest
    problem = _Problem(products, norms, gram, template_sequences, penalty + surcharge, tolerance)
    return problem.solve(_largest(reduced.ravel(), _FIRST), penalty)


class _Problem:
    """A working set of sequences that grows by those whose constraint is violated, until the gap is closed."""

    def __init__(
        self,
        products: NDArray[np.float32],
        norms: NDArray[np.float64],
        gram: NDArray[np.float32],
        template_sequences: TemplateSequences,
        penalties: NDArray[np.float64],
        tolerance: float,
    ) -> None:
        self._products, self._norms, self._gram = products, norms, gram
        self._sequences, self._penalties, self._tolerance = template_sequences, penalties, tolerance
        self._squares = np.square(norms)

    def solve(self, working: NDArray[np.int64], penalty: float) -> OrderedSolution:
        """Grow the working set until the duality gap over all sequences is at most the tolerance."""
        weights = np.zeros(working.size)
        rounds = 0
        while True:
            active, primal, gap, new = self._round(working, weights)
            rounds += 1
            if gap <= self._tolerance or not new.size or rounds == _MOST_ROUNDS:
                return OrderedSolution(working[active], weights[active], primal, max(gap, 0.0), penalty)
            # What has no weight after the first round rarely gets some: a small problem is a fast one.
            working = np.concatenate([working[active], new])
            weights = np.concatenate([weights[active], np.zeros(new.size)])

    def _round(
        self, working: NDArray[np.int64], weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], float, float, NDArray[np.int64]]:
        """Solve for the working set, in place of `weights`, and price all sequences.

        Returns
        -------
        active, primal, gap, new
            Places in the working set with weight; the objective and its relative gap; sequences that are missing.
        """
        frames = self._sequences.frames(working, self._gram.shape[0])
        penalties = self._penalties[working // self._gram.shape[0]]
        blocks, linear = gather(self._gram, self._products, frames)
        residuals = np.empty(self._norms.size)
        minimize(blocks, linear, self._squares, penalties, weights, residuals, 0.1 * self._tolerance)
        active = np.flatnonzero(weights)
        prices = self._prices(frames[active], weights[active], residuals)
        primal = float(residuals.mean() + penalties @ weights)
        agreement = (self._squares - linear @ weights) / np.maximum(residuals, FLOOR)
        gap = (primal - self._feasible(prices) * float(agreement.mean())) / primal
        reduced = (prices - self._penalties[:, np.newaxis].astype(np.float32)).ravel()
        reduced[working] = -np.inf
        new = _largest(reduced, _MORE)
        return active, primal, gap, new[reduced[new] > 0.0]

    def _prices(
        self, frames: NDArray[np.int64], weights: NDArray[np.float64], residuals: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return 1/l sum_i x_{j,i} . theta_i of all sequences, (speeds, n), for theta_i = r_i / ||r_i||."""
        explained = np.empty_like(self._products)
        combine(self._gram, frames, weights.astype(np.float32), explained)
        scale = (1.0 / np.maximum(residuals, FLOOR)).astype(np.float32)
        return self._sequences.means((self._products - explained) * scale[:, np.newaxis])

    def _feasible(self, prices: NDArray[np.float32]) -> float:
        """Return by how much the dual point is to be scaled so that it satisfies all constraints."""
        worst = prices.max(axis=1).astype(np.float64)
        return float(np.min(np.divide(self._penalties, worst, out=np.ones(worst.shape), where=worst > self._penalties)))


def _largest(values: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Return where the largest finite values are."""
    count = min(count, values.size)
    where = np.argpartition(-values, count - 1)[:count]
    found: NDArray[np.int64] = where[np.isfinite(values[where])]
    return found
