"""The say of several plans in the next atoms.

Each atom is made as often as there is weight behind it, what is owed being carried from frame to frame (error
diffusion, Floyd and Steinberg 1976): where a third of the weight turns left at every frame, a robot that never did
would drift off the way.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from smal.action_space import Atom

_TIE = 1e-9

#: Frames over which progress is averaged; about what a turn takes.
PROGRESS_TICKS = 10.0
#: A demonstrated frame this much further from the last one than the robot has driven is in another part of the drive.
_ELSEWHERE_TICKS = 5


class PlanVotes:
    """Votes on the atoms to come, and what is owed to atoms that had votes and were not made.

    Parameters
    ----------
    horizon : int
        Atoms in a plan.
    """

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self.clear()

    def clear(self) -> None:
        """Forget all votes and debts: what comes next has nothing to do with them."""
        self._votes: deque[NDArray[np.float64]] = deque()
        self._owed = np.zeros(len(Atom))

    def cast(self, plans: Sequence[tuple[Sequence[Atom], float]], persistence: float) -> tuple[Atom, ...]:
        """Put plans, each with its weight, to the vote; the first one's atom is made where votes tie.

        Parameters
        ----------
        plans : sequence of (sequence of Atom, float)
            Plans of `horizon` atoms, and their weights, which are positive.
        persistence : float
            The share, 0 to 1, that the votes of before keep. Where the same plan is put to the vote before every atom,
            its atom j of l has the share (1 - p) p^j in what is made, and its last one p^(l - 1): a persistence of 1
            is l - 1 atoms ahead.

        Returns
        -------
        tuple of Atom, `horizon` long
        """
        votes = np.zeros((self._horizon, len(Atom)))
        for atoms, weight in plans:
            votes[np.arange(self._horizon), atoms] += weight
        votes /= votes.sum(axis=1, keepdims=True)
        if persistence > 0.0 and self._votes:
            before = np.array(self._votes)
            votes[: len(before)] += persistence * (before - votes[: len(before)])
        self._votes = deque(votes)
        return self._diffused(plans[0][0])

    def made(self, atom: Atom) -> None:
        """Take note of the atom that the robot makes."""
        if self._votes:
            self._owed += self._votes.popleft()
            self._owed[atom] -= 1.0

    def _diffused(self, favourites: Sequence[Atom]) -> tuple[Atom, ...]:
        """Choose atoms by their shares of the votes and what is owed to them; the favourite where they tie."""
        owed, atoms = self._owed.copy(), []
        for shares, favourite in zip(self._votes, favourites, strict=True):
            owed += shares
            claims = owed.copy()
            claims[favourite] += _TIE
            atoms.append(Atom(int(claims.argmax())))
            owed[atoms[-1]] -= 1.0
        return tuple(atoms)


class Progress:
    """How fast the demonstration that is followed goes by: frames of it per frame driven, 0 (stuck) to 1.

    Parameters
    ----------
    stride : int
        Frames driven between two decisions. Where a decision comes late, more, the robot seems faster than it is.
    """

    def __init__(self, stride: int) -> None:
        self._stride = stride
        self._rate = min(1.0, stride / PROGRESS_TICKS)
        self.reset()

    @property
    def value(self) -> float:
        """0 where the demonstrated frame stays the same, or goes to and fro, 1 where it moves as the robot does."""
        return min(max(self._mean, 0.0), 1.0)

    def reset(self) -> None:
        """Begin a new way, with nothing known against it."""
        self._mean = 1.0
        self._where: tuple[int, int] | None = None

    def follow(self, demonstration: int, frame: int) -> None:
        """Take note of the demonstrated frame that a decision starts from."""
        gained = 1.0  # another demonstration, or another part of it: nothing shows that the robot is stuck
        if self._where is not None and self._where[0] == demonstration:
            moved = frame - self._where[1]
            if abs(moved) <= self._stride + _ELSEWHERE_TICKS:
                gained = moved / self._stride
        self._mean += self._rate * (gained - self._mean)
        self._where = (demonstration, frame)
