"""Align a query with the demonstrations, to the frame: first by W, then by the order of frames.

W tells which state a query shows, and roughly the phase, the frame of the state's template at which the query is. Only
roughly: the penalties of Eq. 7 spread weight over frames that resemble each other, and do not know their order. An
action that is continued half a second early or late turns at the wrong place. So we look around that phase for the
one at which the query, frame by frame in order, resembles the demonstration most. The paper does not: it executes the
whole action wherever in the state the robot is.

How similar the query is there says which of the states with weight the robot is in. Under another light, templates
explain together what all views have in common now and the demonstrations had not; such weights are no evidence for a
place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.inner_products import Columns
from smal.sequences import first_frame
from smal.state_matching import Solution

#: Frames to both sides of the phase that W tells among which the best one is taken.
REACH = 5
# Nearest first, since the first of equally good phases is taken.
_STEPS = np.array(sorted(range(-REACH, REACH + 1), key=abs))
#: Frames back at which a frame's say has fallen to 1/e. A decision is about now: of all that a window shows, its last
#: frames are nearest to what the robot sees, and to its heading.
RECENCY_TICKS = 3.0

#: Concentration of views about the demonstrated ones (von Mises and Fisher): where the similarity is 0.1 less, it is
#: 20 times less likely that the robot is there.
CONCENTRATION = 30.0

#: Of template frames (k, a, q): their inner products with the q query frames, (k, a, q). Of -1 anything.
Correlate = Callable[[Columns], NDArray[Any]]
# Share of the largest weight of a block below which a weight is rounding.
_NO_WEIGHT = 1e-9


def phase(weights_block: NDArray[Any]) -> float:
    """Template frame at which the last query frame is, from one block of W.

    Row r of the block with weight on query frame i says that the query is r - i frames ahead of the template.
    The weighted median of r - i (interpolated) is the shift between the two sequences. Query frames beyond the
    template put their weight on its first or last row, which pulls a mean towards no shift, a median less.

    Parameters
    ----------
    weights_block : array (l, q)
        Rows of W of the matched sequence. Negative weights say where the query is not, and do not count.

    Returns
    -------
    float
        0 is the first frame of the template, q - 1 no shift, more than l - 1 beyond its end.
    """
    length, queries = weights_block.shape
    present = np.maximum(weights_block, 0.0)
    largest = present.max()
    if largest == 0.0:
        return float(queries - 1)
    # Entry j is the weight of the shift j - (q - 1), that is of the phase j.
    by_phase = np.array([np.trace(present / largest, -shift) for shift in range(1 - queries, length)])
    phases = np.flatnonzero(by_phase > _NO_WEIGHT)
    middles = np.cumsum(by_phase[phases]) - by_phase[phases] / 2.0
    return float(np.interp(by_phase[phases].sum() / 2.0, middles, phases))


def matched_phase(solution: Solution, state: int) -> float:
    """`phase` of a solution with respect to one template sequence."""
    length = solution.sequence_length
    block = np.zeros((length, solution.shape[1]))
    inside = solution.active // length == state
    block[solution.active[inside] % length] = solution.active_weights[inside]
    return phase(block)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where states are aligned with a query.

    Parameters
    ----------
    phases : float64 array (k,)
        Template frame at which the last query frame is.
    similarity : float64 array (k,)
        Mean inner product of the query frames with the demonstrated ones, recent frames counting more; -inf where
        nothing that was demonstrated is within reach.
    """

    phases: NDArray[np.float64]
    similarity: NDArray[np.float64]


def recency(frames: int, recency_ticks: float) -> NDArray[np.float64]:
    """Return how much each of the last frames counts, in order: exp(-k / recency_ticks) k frames back, (frames,)."""
    return np.exp(-np.arange(frames)[::-1] / recency_ticks)


def relative_likelihood(similarity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return exp(CONCENTRATION * similarity), divided by the largest; ones where nothing is like anything."""
    largest = similarity.max(initial=-np.inf)
    return np.exp(CONCENTRATION * (similarity - largest)) if np.isfinite(largest) else np.ones_like(similarity)


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
                # What lies beyond the template looks about like its first, or its last, frame.
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
        weights: NDArray[np.float64],
        correlate: Correlate,
    ) -> Alignment:
        """Find the phases at which the last frames, in order, resemble what was demonstrated most.

        Parameters
        ----------
        states : sequence of int (k,)
        phases : sequence of float (k,)
            About where the query's last frame is in each (`smal.alignment.phase`).
        weights : float64 array (q,)
            How much each frame of the query counts, not negative (`recency`); 0 for a hidden one.
        correlate : callable
            See `Correlate`.

        Returns
        -------
        Alignment
            Whole frames, at most `REACH` from the given phases; of equally good ones the nearest. A given phase stays
            where nothing that was demonstrated is within reach.
        """
        rough = np.rint(phases).astype(np.intp)
        firsts = np.array([self._first[state] for state in states], dtype=np.intp)
        ends = firsts[:, None] + rough[:, None] + _STEPS
        # Whatever lies outside falls into the gaps at both ends.
        inside = np.clip(ends[..., None] - np.arange(weights.size)[::-1], 0, self._columns.size - 1)
        columns = self._columns[inside]
        shown = columns >= 0
        counted = weights * shown
        similarity = (counted * correlate(columns)).sum(axis=-1) / np.maximum(counted.sum(axis=-1), 1e-300)
        possible = shown[..., -1]
        similarity = np.where(possible, similarity, -np.inf)
        found = rough + _STEPS[similarity.argmax(axis=1)]
        return Alignment(np.where(possible.any(axis=1), found, phases), similarity.max(axis=1))


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
        sequences = frames[first_frame(len(frames), sequence_length) :].reshape(-1, sequence_length, frames.shape[1])
        for number, (state, sequence) in enumerate(zip(stream.tolist(), sequences, strict=True)):
            if state in made:
                correlate = partial(_correlate, templates, sequence)
                weights = recency(sequence_length, RECENCY_TICKS)
                found[number] = order.align([state], [float(ends[number])], weights, correlate).phases[0]
            made.add(state)
        aligned.append(found)
    return tuple(aligned)


def _correlate(templates: NDArray[np.float32], sequence: NDArray[np.float32], columns: Columns) -> NDArray[np.float32]:
    used, where = np.unique(columns, return_inverse=True)
    products = templates[:, used].T @ sequence.T
    correlations: NDArray[np.float32] = products[where.reshape(columns.shape), np.arange(len(sequence))]
    return correlations
