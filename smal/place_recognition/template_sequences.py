"""Template sequences at every start and at many speeds, without a copy of any frame.

The paper cuts templates at fixed phases, each sequence l successive frames (k = floor(n / l) of them). A query that is
driven faster, slower, or from another first frame then fits no sequence. Here a sequence ends at any reference, and
advances at any of some speeds: v reference frames to one query frame.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smal.paper.compiled import compiled
from smal.place_recognition.trajectories import steps_back

#: Reference frames to one query frame, in quarters of an octave from half to twice.
SPEEDS = tuple(2.0 ** (step / 4) for step in range(-4, 5))


@dataclass(frozen=True)
class TemplateSequences:
    """All sequences of l frames within n reference frames: one for each speed and each last frame.

    Sequence (v, e) has the frames e - round(v (l - 1 - i)), i = 0..l-1 (`trajectories.steps_back`); it exists where the
    first of them does.

    Parameters
    ----------
    length : int
        l, at least 1.
    speeds : tuple of float
        v, positive; with l = 1 they make no difference, and one is enough.

    Raises
    ------
    ValueError
        A number is out of its range.
    """

    length: int
    speeds: tuple[float, ...] = SPEEDS

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"a template sequence needs at least 1 frame, got {self.length}")
        if not self.speeds or not all(math.isfinite(speed) and speed > 0.0 for speed in self.speeds):
            raise ValueError(f"speeds must be finite and positive, got {self.speeds}")

    @cached_property
    def back(self) -> NDArray[np.int64]:
        """How many frames before its last one the i-th frame of a sequence is, (speeds, l)."""
        return np.ascontiguousarray(steps_back(self.speeds, self.length)[:, ::-1])

    @cached_property
    def octaves(self) -> NDArray[np.float64]:
        """log2 of the speeds."""
        octaves: NDArray[np.float64] = np.log2(np.asarray(self.speeds))
        return octaves

    def frames(self, sequences: NDArray[np.int64], references: int) -> NDArray[np.int64]:
        """Return the frames of some sequences, (p, l); a sequence is numbered v n + e."""
        speed, end = np.divmod(sequences, references)
        found: NDArray[np.int64] = end[:, np.newaxis] - self.back[speed]
        return found

    def means(self, products: NDArray[np.float32]) -> NDArray[np.float32]:
        """Average products along every sequence.

        Parameters
        ----------
        products : float32 array (l, n)
            Of the i-th query frame with every reference.

        Returns
        -------
        float32 array (speeds, n)
            1/l sum_i products[i, frame i of sequence (v, e)]; -inf where there is no sequence.
        """
        total = np.empty((len(self.speeds), products.shape[1]), dtype=np.float32)
        _means(products, self.back, total)
        return total


@compiled
def _means(products: NDArray[np.float32], back: NDArray[np.int64], total: NDArray[np.float32]) -> None:
    length, references = products.shape
    for speed in range(back.shape[0]):
        first = min(back[speed, 0], references)
        total[speed, :first] = -np.inf
        total[speed, first:] = 0.0
        for i in range(length):
            shift = back[speed, i]
            for end in range(first, references):
                total[speed, end] += products[i, end - shift]
        for end in range(first, references):
            total[speed, end] /= np.float32(length)
