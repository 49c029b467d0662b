"""Where in the demonstrations a query is, to the frame.

W tells which state a query shows. It tells the phase within it only roughly: the penalties of Eq. 7 spread weight over
frames that resemble each other, and do not know their order. Continued half a second early or late, an action turns at
the wrong place. So we look around the phase that W tells for the one at which the query, frame by frame in order,
resembles the demonstration most. The paper does not: it executes the whole action wherever in the state the robot is.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Frames to both sides of the phase that W tells among which the best one is taken.
REACH = 5
#: Frames back at which a frame's say has fallen to 1/e. A decision is about now: of all that a window shows, its last
#: frames are nearest to what the robot sees, and to its heading.
RECENCY_TICKS = 3.0

Columns = NDArray[np.intp]
#: Of template frames (k, a, q): their inner products with the q query frames, (k, a, q). Of -1 anything.
Correlate = Callable[[Columns], NDArray[Any]]


class DemonstratedOrder:
    """Template frames in the order in which they were demonstrated.

    Parameters
    ----------
    streams : sequence of int arrays (f_d // l,)
        State of every sequence of every demonstration, in time (`smal.state_space`).
    phases : sequence of float arrays (f_d // l,)
        Frame of its state's template at which each sequence ends; l - 1 for the sequence that the state was made of.
    sequence_length : int
        l.
    """

    def __init__(self, streams: Sequence[NDArray[Any]], phases: Sequence[NDArray[Any]], sequence_length: int) -> None:
        length = sequence_length
        # Between demonstrations there is nothing, as far as any query reaches.
        gap = np.full(2 * length + REACH, -1)
        # The first sequence of a state is the one that it was made of.
        self._first: dict[int, int] = {}
        parts, position = [gap], gap.size
        for stream, ends in zip(streams, phases, strict=True):
            for state, end in zip(stream.tolist(), ends.tolist(), strict=True):
                self._first.setdefault(state, position)
                shown = np.clip(round(end) - length + 1 + np.arange(length), 0, length - 1)
                parts.append(state * length + shown)
                position += length
            parts.append(gap)
            position += gap.size
        self._columns: Columns = np.concatenate(parts)

    def align(
        self,
        states: Sequence[int],
        phases: Sequence[float],
        frames: int,
        correlate: Correlate,
        recency_ticks: float = RECENCY_TICKS,
    ) -> NDArray[np.float64]:
        """Find the phases at which the last frames, in order, resemble what was demonstrated most.

        Parameters
        ----------
        states : sequence of int (k,)
        phases : sequence of float (k,)
            About where the query's last frame is in each (`smal.state_space.phase`).
        frames : int
            q, frames of the query.
        correlate : callable
            See `Correlate`.
        recency_ticks : float
            The inner product k frames back counts exp(-k / recency_ticks).

        Returns
        -------
        float64 array (k,)
            Whole frames, at most `REACH` from the given ones; of equally good ones the nearest. A given phase stays
            where nothing that was demonstrated is within reach.
        """
        rough = np.rint(np.asarray(phases, dtype=np.float64)).astype(np.intp)
        # Nearest first, since the first of the best is taken.
        steps = np.array(sorted(range(-REACH, REACH + 1), key=abs))
        firsts = np.array([self._first[state] for state in states], dtype=np.intp)
        ends = firsts[:, None] + rough[:, None] + steps
        back = np.arange(frames)[::-1]
        inside = np.clip(ends[..., None] - back, 0, self._columns.size - 1)
        columns = self._columns[inside]
        shown = columns >= 0
        weights = np.exp(-back / recency_ticks) * shown
        likeness = (weights * correlate(columns)).sum(axis=-1) / np.maximum(weights.sum(axis=-1), 1e-300)
        possible = shown[..., -1] & (ends < self._columns.size)
        best = np.where(possible, likeness, -np.inf).argmax(axis=1)
        found = rough + steps[best]
        return np.where(possible.any(axis=1), found, np.asarray(phases, dtype=np.float64))


def aligned_phases(
    templates: NDArray[np.float32],
    streams: Sequence[NDArray[np.int32]],
    phases: Sequence[NDArray[np.float32]],
    demonstrations: Sequence[NDArray[np.float32]],
    sequence_length: int,
) -> tuple[NDArray[np.float32], ...]:
    """Align the demonstrated sequences themselves with the states that they were found to show.

    Parameters
    ----------
    templates, streams, phases
        Of `smal.state_space.StateSpace`.
    demonstrations : sequence of float32 arrays (f_d, m)
        Centred features.
    sequence_length : int
        l.

    Returns
    -------
    tuple of float32 arrays (f_d // l,)
        l - 1 for every sequence that a state was made of, as it was.
    """
    order = DemonstratedOrder(streams, phases, sequence_length)
    made: set[int] = set()
    aligned = []
    for frames, stream, ends in zip(demonstrations, streams, phases, strict=True):
        found = ends.copy()
        sequences = frames[len(frames) % sequence_length :].reshape(-1, sequence_length, frames.shape[1])
        for number, (state, sequence) in enumerate(zip(stream.tolist(), sequences, strict=True)):
            if state in made:
                correlate = partial(_correlate, templates, sequence)
                found[number] = order.align([state], [float(ends[number])], sequence_length, correlate)[0]
            made.add(state)
        aligned.append(found)
    return tuple(aligned)


def _correlate(templates: NDArray[np.float32], sequence: NDArray[np.float32], columns: Columns) -> NDArray[np.float32]:
    used, where = np.unique(columns, return_inverse=True)
    products = templates[:, used].T @ sequence.T
    correlations: NDArray[np.float32] = products[where.reshape(columns.shape), np.arange(len(sequence))]
    return correlations
