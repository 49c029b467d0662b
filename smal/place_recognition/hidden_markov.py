"""Hidden Markov model of a traverse among the references: states (reference, speed), and "no reference shows it".

A state advances by its speed at each query, forwards or backwards along the references. Speeds change slowly, jumps are
rare, and a state beyond the end of the references becomes "none". Positions between references are interpolated.
"""

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from scipy import sparse

from smal.arrays import AnyArray, Float32s, Floats
from smal.features.extraction import still_wanted

#: References to one query, or backwards.
SPEEDS: Final = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0)
#: Probability, for each query, that the speed stays.
_KEPT: Final = 0.8
#: Probability that the slowest moving state stops, and that a standing state still stands. Visible stops are removed
#: beforehand, so that a state that seems to stand is rather "none".
_STOPS = 0.01
_STANDS = 0.5
#: Probability of a jump to any place.
_JUMP: Final = 1e-4
#: Probability that no reference shows the queries any more, and that one shows them again.
_LEAVES = 0.01
_RETURNS = 0.05
#: Probability that no reference shows the first query.
_FIRST_NONE: Final = 0.05


class Chain:
    """Transitions among the states of n references; a state vector is speeds by references, then "none"; float32."""

    def __init__(self, references: int) -> None:
        self._shape = 2 * len(SPEEDS), references
        stays = 1.0 - _JUMP - _LEAVES
        self._speeds = (stays * np.kron(np.eye(2), _changes())).astype(np.float32)
        moves = [_moved(references, sign * speed) for sign in (1, -1) for speed in SPEEDS]
        # With a row and a column of zeros for "none".
        self._move = sparse.block_diag([*moves, [[0.0]]], format="csr", dtype=np.float32)
        self._unmove = self._move.T.tocsr()
        # The remaining probability leaves the references.
        ones = np.ones(self._move.shape[0], np.float32)
        self._leaves = 1.0 - _JUMP - self._mixed(self._speeds.T, self._unmove @ ones)[:-1]

    def first(self) -> Float32s:
        """Return the belief before the first query."""
        states = self._move.shape[0] - 1
        belief = np.full(states, (1.0 - _FIRST_NONE) / states)
        return np.append(belief, _FIRST_NONE).astype(np.float32)

    def ahead(self, belief: Float32s) -> Float32s:
        """Return the predicted belief, of sum 1, at the next query."""
        none = belief[-1]
        after = self._move @ self._mixed(self._speeds, belief)
        after += (_JUMP * (1.0 - none) + _RETURNS * none) / (belief.size - 1)
        after[-1] = (1.0 - _RETURNS) * none + self._leaves @ belief[:-1]
        return after

    def back(self, message: Float32s) -> Float32s:
        """Return the message of the next query to this query: the adjoint of `ahead`."""
        none = message[-1]
        mean = message[:-1].mean()
        before = self._mixed(self._speeds.T, self._unmove @ message)
        before[:-1] += _JUMP * mean + self._leaves * none
        before[-1] = (1.0 - _RETURNS) * none + _RETURNS * mean
        return before

    def weighed(self, belief: Float32s, ratios: Float32s) -> Float32s:
        """Weigh a belief by the likelihood ratios of a query, and scale it to a sum of 1."""
        weighed = belief.copy()
        weighed[:-1].reshape(self._shape)[:] *= ratios
        weighed /= weighed.sum()
        return weighed

    def _mixed(self, speeds: Float32s, belief: Float32s) -> Float32s:
        """Return a belief, or a message, after a change of speeds, without "none"."""
        mixed = np.zeros_like(belief)
        np.matmul(speeds, belief[:-1].reshape(self._shape), out=mixed[:-1].reshape(self._shape))
        return mixed

    def at_references(self, belief: Float32s) -> tuple[Float32s, float]:
        """Return the probabilities of the references (n,), and of "none"."""
        belief = belief / belief.sum()
        return belief[:-1].reshape(self._shape).sum(axis=0), float(belief[-1])


def _changes() -> Floats:
    """Return the transition probabilities of speeds, to (rows) and from (columns)."""
    count = len(SPEEDS)
    changes = _KEPT * np.eye(count)
    for speed in range(count):
        for after in (speed - 1, speed + 1):
            changes[min(max(after, 0), count - 1), speed] += (1.0 - _KEPT) / 2.0
    changes[:2, 0] = _STANDS, 1.0 - _STANDS
    changes[:2, 1] += (_STOPS - changes[0, 1]) * np.array([1.0, -1.0])
    return changes


def _moved(references: int, advance: float) -> sparse.dia_array:
    """Return the matrix that moves a distribution over references; states beyond the ends are lost."""
    whole = math.floor(advance)
    shares = np.array([whole + 1 - advance, advance - whole])
    diagonals = np.repeat(shares, references).reshape(2, -1)
    return sparse.dia_array((diagonals, (-whole, -whole - 1)), (references, references))


def smoothed(
    chain: Chain, seen: AnyArray, ratios: Callable[[AnyArray], Float32s]
) -> Iterator[tuple[int, Float32s, float]]:
    """Yield for each query, the last first, the probabilities of the references (n,) and of "none" given all queries.

    This is the forward-backward algorithm. `ratios` returns the likelihood ratios, here to elsewhere, of some rows of
    `seen` (q, n). Beliefs are many times as large as `seen`: only some are stored, the others are computed again.
    """
    block = math.isqrt(len(seen) - 1) + 1

    def forward(belief: Float32s, rows: Float32s) -> list[Float32s]:
        """Return the beliefs at some queries, from the predicted belief at the first."""
        still_wanted()
        found = [chain.weighed(belief, rows[0])]
        for row in rows[1:]:
            found.append(chain.weighed(chain.ahead(found[-1]), row))
        return found

    before = [chain.first()]
    for start in range(0, len(seen) - block, block):
        rows = ratios(seen[start : start + block])
        before.append(chain.ahead(forward(before[-1], rows)[-1]))
    message = np.ones_like(before[0])
    for number in reversed(range(len(before))):
        start = number * block
        rows = ratios(seen[number * block : (number + 1) * block])
        for place, belief in reversed(list(enumerate(forward(before[number], rows)))):
            yield start + place, *chain.at_references(belief * message)
            message = chain.back(chain.weighed(message, rows[place]))
