"""SeqSLAM (Milford & Wyeth, ICRA 2012) as the eyes of a robot that searches: frame after frame, ending now.

The demonstrations are the templates. A frame's difference from each of them is enhanced locally within its
demonstration, trajectories lie within one demonstration and end at the last frame. The end of the best one is where
the robot is.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.seqslam import SeqSlamSettings, differences, enhanced


class Place(NamedTuple):
    """A frame of a demonstration: number of the demonstration, frame, and the mean enhanced difference there."""

    demonstration: int
    frame: int
    cost: float


class SeqSlamLocalizer:
    """Finds the demonstrated frame at which the last d_s frames end.

    There is no novelty test: SeqSLAM's uniqueness asks whether a second place matches as well, and with many
    demonstrations of one route the second best is the same place in another of them. So it always answers, once there
    are d_s frames.

    Parameters
    ----------
    drives : sequence of float32 arrays (f, m)
        Patch-normalized thumbnails (the modality `thumbnail`) of every demonstration.
    settings : SeqSlamSettings
    shorten : bool
        Whether it answers from the first frame on, by as many frames as there are: a robot that waits for d_s frames
        stands still meanwhile, which is no trajectory that is tried.

    Raises
    ------
    ValueError
        No demonstration is long enough for a trajectory.
    """

    def __init__(self, drives: Sequence[NDArray[np.float32]], settings: SeqSlamSettings, shorten: bool = False) -> None:
        self._settings, self._least = settings, 1 if shorten else settings.length
        self._lines = settings.trajectories()
        self._ends = np.cumsum([0, *map(len, drives)])
        self._templates = np.concatenate(drives)
        # Where in its demonstration each template is: a trajectory must not begin before it.
        self._frame = np.concatenate([np.arange(len(each)) for each in drives])
        if not any(line[-1] <= self._frame.max() for line in self._lines):
            raise ValueError(f"no demonstration is long enough for SeqSLAM with a length of {settings.length}")
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=settings.length)

    def reset(self) -> None:
        """Forget all frames, for a new episode."""
        self._rows.clear()

    def observe(self, frame: NDArray[np.float32]) -> Place | None:
        """Take one frame, (m,), and find where the last d_s ended; None as long as there are too few."""
        self._rows.append(self._contrast(frame))
        if len(self._rows) < self._least:
            return None
        rows = list(reversed(self._rows))
        best = np.full(self._frame.size, np.inf, dtype=np.float32)
        for line in {tuple(line[: len(rows)]) for line in self._lines}:
            total = np.full(self._frame.size, np.inf, dtype=np.float32)
            reach = line[-1]
            total[reach:] = 0.0
            for row, step in zip(rows, line, strict=True):
                total[reach:] += row[reach - step : row.size - step]
            np.minimum(best, np.where(self._frame >= reach, total, np.inf), out=best)
        end = int(best.argmin())
        demonstration = int(np.searchsorted(self._ends, end, side="right")) - 1
        return Place(demonstration, int(self._frame[end]), float(best[end]) / len(rows))

    def _contrast(self, query: NDArray[np.float32]) -> NDArray[np.float32]:
        """Local contrast enhancement of one frame against all templates, within each demonstration."""
        row = differences(self._templates, query[np.newaxis])
        parts = [
            enhanced(np.ascontiguousarray(row[:, start:end]), self._settings.half_window)
            for start, end in zip(self._ends[:-1], self._ends[1:], strict=True)
        ]
        contrast: NDArray[np.float32] = np.concatenate(parts, axis=1)[0]
        return contrast
