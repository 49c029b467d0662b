"""State space learning (paper, Algorithm 1): a sequence that matches no state becomes one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smal.paper.matching.products import Known
from smal.paper.novelty import NoveltyTest, describe_match
from smal.paper.sequences import first_frame
from smal.paper.state_matching import solve
from smal.paper.template_store import TemplateStore

Progress = Callable[[int, int], None]

_BATCH = 32


@dataclass(frozen=True, eq=False)
class StateSpace:
    """What Algorithm 1 returns.

    Parameters
    ----------
    templates : float32 array (m, n)
        X; state j is the columns j * l and following.
    streams : tuple of int32 arrays (f_d // l,)
        The paper's s-stream, one per demonstration.
    sequence_length : int
    """

    templates: NDArray[np.float32]
    streams: tuple[NDArray[np.int32], ...]
    sequence_length: int

    @property
    def states(self) -> int:
        """Number of states."""
        return int(self.templates.shape[1]) // self.sequence_length


class _Learner:
    """Algorithm 1 for one sequence after the other."""

    def __init__(self, store: TemplateStore, test: NoveltyTest, length: int, lambda1: float, lambda2: float,
                 tolerance: float) -> None:  # fmt: skip
        self.store, self.test = store, test
        self.parameters = length, lambda1, lambda2, tolerance

    def step(self, frames: NDArray[np.float32], correlations: NDArray[np.float32]) -> int:
        """Return the state of one sequence (l, m) with correlations (n, l), which is a new one if it matches none."""
        store = self.store
        if len(store):
            solution = solve(store.templates, frames.T, *self.parameters, Known(correlations, store.gram))
            match = describe_match(solution, lambda columns: correlations[columns], np.linalg.norm(frames, axis=1))
            if match.state is not None and not self.test.is_novel(match):
                return match.state
        store.append(frames, correlations)
        return len(store) // self.parameters[0] - 1


def _batches(demonstrations: Sequence[NDArray[np.float32]], length: int) -> Iterator[NDArray[np.float32]]:
    """Yield all sequences in order, up to 32 together, as (b, l, m)."""
    sequences: list[NDArray[np.float32]] = []
    for frames in demonstrations:
        for start in range(first_frame(len(frames), length), len(frames), length):
            sequences.append(frames[start : start + length])
            if len(sequences) == _BATCH:
                yield np.stack(sequences)
                sequences = []
    if sequences:
        yield np.stack(sequences)


def learn_state_space(
    demonstrations: Sequence[NDArray[np.float32]],
    sequence_length: int,
    lambda1: float,
    lambda2: float,
    test: NoveltyTest,
    tolerance: float = 1e-3,
    max_bytes: int | None = None,
    progress: Progress | None = None,
) -> StateSpace:
    """Cut demonstrations into sequences and build the states from them.

    Correlations with the templates are computed for 32 sequences in one product; templates that are added
    within the 32 take theirs from the product of the 32 with themselves. The result is that of one by one.

    Parameters
    ----------
    demonstrations : sequence of float32 arrays (f, m)
        Centred features, unit length; a sequence never spans two of them.
    sequence_length : int
        l.
    lambda1, lambda2 : float
        Of Eq. 7.
    test : NoveltyTest
        Eq. 8 or another.
    tolerance : float
        Relative duality gap of each match.
    max_bytes : int, optional
        Bound on the memory of templates and their Gram matrix: n frames need 4 n (m + n) bytes.
    progress : callable, optional
        Called with the number of sequences done and their total.

    Raises
    ------
    ValueError
        No demonstration has l frames.
    MemoryBoundError
    """
    counts = [len(frames) // sequence_length for frames in demonstrations]
    if not sum(counts):
        raise ValueError(f"no demonstration has {sequence_length} frames")
    store = TemplateStore(demonstrations[0].shape[1], max_bytes=max_bytes)
    learner = _Learner(store, test, sequence_length, lambda1, lambda2, tolerance)
    states: list[int] = []
    for batch in _batches(demonstrations, sequence_length):
        _learn_batch(learner, batch, states)
        if progress is not None:
            progress(len(states), sum(counts))
    streams = np.split(np.array(states, dtype=np.int32), np.cumsum(counts)[:-1])
    return StateSpace(store.templates, tuple(streams), sequence_length)


def _learn_batch(learner: _Learner, batch: NDArray[np.float32], states: list[int]) -> None:
    """Match or add the sequences (b, l, m) in order."""
    store, length = learner.store, learner.parameters[0]
    before = len(store)
    frames = batch.reshape(-1, batch.shape[2])
    among = frames @ frames.T
    known = np.empty((before + len(frames), len(frames)), dtype=np.float32)
    np.matmul(store.templates.T, frames.T, out=known[:before])
    for index, sequence in enumerate(batch):
        columns = slice(index * length, (index + 1) * length)
        count = len(store)
        states.append(learner.step(sequence, np.ascontiguousarray(known[:count, columns])))
        if len(store) > count:
            known[count : len(store)] = among[columns]
