"""Detection and alignment of laps, offline with the whole recording.

A frame is a vector of its view and the robot's turn. Half of the squared distance measures how
unlike two frames are: 0 for equal frames, 1 or more for unrelated frames.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Frames = NDArray[np.float64]
# Maximum number of frames of one lap per frame of another, and cost of a skipped frame.
FASTEST = 3
STEP_COST = 0.05
# The first recurrence of views above this share of the best is a lap; later ones are several laps.
FIRST: Final = 0.5
# Largest median distance of a lap, and of its first fifth, from another lap and within itself.
UNLIKE = 0.9
OF_MEDIAN = 2.0
TRIED: Final = 16  # Number of candidate stretches to compare laps with.


class Lap(NamedTuple):
    """A lap: its piece of the drive, its frames [first, last), and their alignment."""

    piece: int
    first: int
    last: int
    shows: NDArray[np.intp]  # Frame of the first returned lap, (last - first,).
    unlike: float  # Distance, as between frames.


def find_laps(pieces: Sequence[Frames]) -> list[Lap]:
    """Return the laps in pieces (f, d) of a drive: one in the middle, then the others in order.

    The whole drive is aligned repeatedly with a stretch of the length of a lap. A lap ends when the
    best alignment passes the end of the stretch. The best of several stretches yields a first set
    of laps; the lap in the middle of the set is the stretch of the final alignment.
    """
    period = _period(pieces)
    stretches = [
        one[at : at + period]
        for one in pieces
        for at in range(0, len(one) - period, period // 2 + 1)
    ]
    if period < 2 or not stretches:
        return []
    tried = stretches[:: -(-len(stretches) // TRIED)]
    best = max(
        (_rounds(pieces, each) for each in tried),
        key=lambda laps: sum(1.0 - lap.unlike for lap in laps),
    )
    if not best:
        return []
    piece, first, last, *_ = best[len(best) // 2]
    found = _rounds(pieces, pieces[piece][first:last])
    others = [lap for lap in found if lap.piece != piece or abs(lap.first - first) >= period // 2]
    return [Lap(piece, first, last, np.arange(last - first), 0.0), *others]


def _period(pieces: Sequence[Frames]) -> int:
    """Return the period of recurring views: the first high peak of their autocorrelation."""
    longest = max(map(len, pieces))
    sums = np.zeros(longest)
    pairs = np.zeros(longest)
    for one in pieces:
        power = np.square(np.abs(np.fft.rfft(one, 2 * len(one), axis=0))).sum(axis=1)
        sums[: len(one)] += np.fft.irfft(power, 2 * len(one))[: len(one)]
        pairs[: len(one)] += np.arange(len(one), 0, -1)
    alike = (sums / pairs)[: longest // 2 + 1]
    rise = alike - np.minimum.accumulate(alike)
    first = int(np.argmax(rise >= FIRST * rise.max()))
    return first + int(np.argmax(rise[first : first + first // 2 + 1]))


def _rounds(pieces: Sequence[Frames], stretch: Frames) -> list[Lap]:
    """Return the rounds of a stretch that resemble it or each other, including their first fifth."""
    found = []
    for number, piece in enumerate(pieces):
        where = aligned(piece, stretch)
        unlike = np.square(piece - stretch[where]).sum(axis=1) / 2.0
        for first, last in pairwise((np.flatnonzero(np.diff(where) < 0) + 1).tolist()):
            begin = first + (last - first + 4) // 5
            costs = unlike[first:last].mean(), unlike[first:begin].mean()
            found.append(Lap(number, first, last, where[first:last], float(max(costs))))
    most = min(UNLIKE, OF_MEDIAN * float(np.median([lap.unlike for lap in found] or [0.0])))
    return [lap for lap in found if lap.unlike <= most]


def aligned(frames: Frames, closed: Frames) -> NDArray[np.intp]:
    """Return the frame of a closed lap (g, d) that each frame (f, d) shows, (f,)."""
    unlike = cdist(frames, closed, "sqeuclidean") / 2.0
    came = np.zeros(unlike.shape, dtype=np.intp)
    cost = unlike[0]
    for frame in range(1, len(unlike)):
        ways = np.stack(
            [np.roll(cost, step) + STEP_COST * abs(step - 1) for step in range(FASTEST + 1)]
        )
        came[frame] = ways.argmin(axis=0)
        cost = ways.min(axis=0) + unlike[frame]
    where = np.empty(len(unlike), dtype=np.intp)
    at = int(cost.argmin())
    for frame in range(len(unlike) - 1, -1, -1):
        where[frame] = at
        at = (at - int(came[frame, at])) % len(closed)
    return where
