"""From what a method recognizes to the demonstrated frame that it takes the robot to be at.

With it methods that answer in states, and those that answer in frames, are judged by one criterion: how far from the
true pose that frame was taken.
"""

import numpy as np

from smal.paper.model import Model
from smal.paper.sequences import last_frames


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
            Frame of the state's template, at least 0 (`smal.paper.phase`); those beyond it are the frames that came
            after it, but for the end of the demonstration.
        """
        return int(min(self._begin[state] + round(phase), self._last[state]))
