"""Where a traverse is among the references: a hidden Markov model of (reference, speed), and of "none shows it".

A state advances by its speed at each query, forwards or backwards along the references. Speeds change slowly, jumps are
rare, and what runs off the end of the references is nowhere among them. Frames between references are shared out.
"""

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from scipy import sparse

from smal.arrays import AnyArray, Float32s, Floats
from smal.features.extraction import still_wanted

SPEEDS: Final = (
    0.0,
    0.5,
    0.75,
    1.0,
    1.25,
    1.5,
    2.0,
    2.5,
    3.0,
    4.0,
)  # References to one query, or backwards.
#: Probabilities with each query: that the speed stays; that who is slow stops, and who stands does so still (stops that
#: can be seen are left out beforehand, so that who seems to stand is rather nowhere); of a jump to anywhere; that no
#: reference shows it any more, or one shows it again; and that none shows the first one.
_KEPT: Final = 0.8
_STOPS = 0.01
_STANDS = 0.5
_JUMP: Final = 1e-4
_LEAVES = 0.01
_RETURNS = 0.05
_FIRST_NONE: Final = 0.05


class Chain:
    """The states of n references, a vector each: speeds by references, then "none". Messages are of float32."""

    def __init__(self, references: int) -> None:
        self._shape = 2 * len(SPEEDS), references
        stays = 1.0 - _JUMP - _LEAVES
        self._speeds = (stays * np.kron(np.eye(2), _changes())).astype(np.float32)
        moves = [_moved(references, sign * speed) for sign in (1, -1) for speed in SPEEDS]
        # With a row and a column of zeros for "none".
        self._move = sparse.block_diag([*moves, [[0.0]]], format="csr", dtype=np.float32)
        self._unmove = self._move.T.tocsr()
        # What does not stay among the references has left them.
        ones = np.ones(self._move.shape[0], np.float32)
        self._leaves = 1.0 - _JUMP - self._mixed(self._speeds.T, self._unmove @ ones)[:-1]

    def first(self) -> Float32s:
        """Return the belief before the first query."""
        states = self._move.shape[0] - 1
        return np.append(np.full(states, (1.0 - _FIRST_NONE) / states), _FIRST_NONE).astype(
            np.float32
        )

    def ahead(self, belief: Float32s) -> Float32s:
        """Return the belief, of sum 1, at the next query, before it is seen."""
        none = belief[-1]
        after = self._move @ self._mixed(self._speeds, belief)
        after += (_JUMP * (1.0 - none) + _RETURNS * none) / (belief.size - 1)
        after[-1] = (1.0 - _RETURNS) * none + self._leaves @ belief[:-1]
        return after

    def back(self, message: Float32s) -> Float32s:
        """Return what a message about the next query says about this one: the adjoint of `ahead`."""
        none = message[-1]
        mean = message[:-1].mean()
        before = self._mixed(self._speeds.T, self._unmove @ message)
        before[:-1] += _JUMP * mean + self._leaves * none
        before[-1] = (1.0 - _RETURNS) * none + _RETURNS * mean
        return before

    def seen(self, belief: Float32s, ratios: Float32s) -> Float32s:
        """Weigh a belief by what a query says, and scale it to a sum of 1."""
        weighed = belief.copy()
        weighed[:-1].reshape(self._shape)[:] *= ratios
        weighed /= weighed.sum()
        return weighed

    def _mixed(self, speeds: Float32s, belief: Float32s) -> Float32s:
        """Return a belief, or a message, after a change of speeds; of none nothing."""
        mixed = np.zeros_like(belief)
        np.matmul(speeds, belief[:-1].reshape(self._shape), out=mixed[:-1].reshape(self._shape))
        return mixed

    def at_references(self, belief: Float32s) -> tuple[Float32s, float]:
        """Return the probabilities of the references (n,), and that none shows the query."""
        belief = belief / belief.sum()
        return belief[:-1].reshape(self._shape).sum(axis=0), float(belief[-1])


def _changes() -> Floats:
    """Return the probabilities of each speed (a row) after each other one (a column)."""
    count = len(SPEEDS)
    changes = _KEPT * np.eye(count)
    for speed in range(count):
        for after in (speed - 1, speed + 1):
            changes[min(max(after, 0), count - 1), speed] += (1.0 - _KEPT) / 2.0
    changes[:2, 0] = _STANDS, 1.0 - _STANDS
    changes[:2, 1] += (_STOPS - changes[0, 1]) * np.array([1.0, -1.0])
    return changes


def _moved(references: int, advance: float) -> sparse.dia_array:
    """Return the matrix that moves a distribution over references; what lies beyond them is lost."""
    whole = math.floor(advance)
    shares = np.array([whole + 1 - advance, advance - whole])
    return sparse.dia_array(
        (np.repeat(shares, references).reshape(2, -1), (-whole, -whole - 1)), (references,) * 2
    )


def smoothed(
    chain: Chain, seen: AnyArray, ratios: Callable[[AnyArray], Float32s]
) -> Iterator[tuple[int, Float32s, float]]:
    """Yield each query, the probabilities of the references (n,) given all queries, and of none: forward-backward.

    Of what was seen, (q, n), `ratios` says what the likelihood ratios are, here against elsewhere. The last comes
    first. Of the beliefs, which are many times as large, only some are kept, and those between computed again.
    """
    block = math.isqrt(len(seen) - 1) + 1

    def forward(belief: Float32s, rows: Float32s) -> list[Float32s]:
        """Return the beliefs at some queries, of the one before the first of them is seen."""
        still_wanted()
        found = [chain.seen(belief, rows[0])]
        for row in rows[1:]:
            found.append(chain.seen(chain.ahead(found[-1]), row))
        return found

    before = [chain.first()]
    for start in range(0, len(seen) - block, block):
        before.append(chain.ahead(forward(before[-1], ratios(seen[start : start + block]))[-1]))
    message = np.ones_like(before[0])
    for number in reversed(range(len(before))):
        start = number * block
        rows = ratios(seen[number * block : (number + 1) * block])
        for place, belief in reversed(list(enumerate(forward(before[number], rows)))):
            yield start + place, *chain.at_references(belief * message)
            message = chain.back(chain.seen(message, rows[place]))
