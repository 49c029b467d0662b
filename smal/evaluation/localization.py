"""From what a method recognizes to the demonstrated frame that it takes the robot to be at.

With it methods that answer in states, and those that answer in frames, are judged by one criterion: how far from the
true pose that frame was taken.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from smal.model import Model
from smal.sequences import last_frames


class DemonstratedFrames:
    """Where in the demonstrations of a model a state and a phase are."""

    def __init__(self, model: Model) -> None:
        counts = [len(atoms) for atoms in model.atoms]
        starts = np.cumsum([0, *counts[:-1]])
        ends = [start + last_frames(count, model.sequence_length) for start, count in zip(starts, counts, strict=True)]
        lasts = np.repeat(starts + counts - 1, [len(each) for each in ends])
        # The first sequence of a state is the one that it was made of.
        _, made = np.unique(np.concatenate(model.state_streams), return_index=True)
        self._begin, self._last = np.concatenate(ends)[made] - model.sequence_length + 1, lasts[made]

    def frame(self, state: int, phase: float) -> int:
        """Return the frame, counted over all demonstrations in order, that a frame of a state's template was.

        Parameters
        ----------
        state : int
            0 to the number of states - 1.
        phase : float
            Frame of the state's template, at least 0 (`smal.phase`); those beyond it are the frames that came after it,
            but for the end of the demonstration.
        """
        return int(min(self._begin[state] + round(phase), self._last[state]))


def nearest_windows(
    demonstrations: Sequence[NDArray[np.float32]], queries: NDArray[np.float32], frames: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the demonstrated windows that differ least from the windows of a query traverse.

        score(t) = - min_j  1/f  sum_{k=0}^{f-1} || y_{t-k} - x_{j-k} ||^2

    Parameters
    ----------
    demonstrations : sequence of float32 arrays (n_d, m)
        Centred features x. Windows never span two demonstrations.
    queries : float32 array (q, m)
        Centred features y of one traverse in order.
    frames : int
        f, at least 1.

    Returns
    -------
    frame : int64 array (q,)
        Last frame j of the nearest window, counted over all demonstrations in order; -1 for the first f - 1 queries.
    score : float64 array (q,)
        At most 0; 0 where there is no answer.

    Raises
    ------
    ValueError
        frames out of range, or no demonstration is so long.
    """
    if not 1 <= frames <= max((len(each) for each in demonstrations), default=0):
        raise ValueError(f"frames must be 1 to the length of the longest demonstration, got {frames}")
    count = len(queries)
    best, score = np.full(count, -1, dtype=np.int64), np.zeros(count)
    least = np.full(max(0, count - frames + 1), np.inf)
    squares, start = np.square(queries).sum(axis=1), 0
    for templates in demonstrations:
        width = len(templates) - frames + 1
        if width > 0 and least.size:
            apart = squares[:, None] + np.square(templates).sum(axis=1) - 2.0 * (queries @ templates.T)
            total = np.zeros((least.size, width))
            for k in range(frames):
                total += apart[k : k + least.size, k : k + width]
            nearest = total.argmin(axis=1)
            value = total[np.arange(least.size), nearest]
            nearer = value < least
            least[nearer] = value[nearer]
            best[frames - 1 :][nearer] = start + frames - 1 + nearest[nearer]
        start += len(templates)
    score[frames - 1 :] = -least / frames
    return best, np.minimum(score, 0.0)
