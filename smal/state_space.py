"""State space learning (paper, Algorithm 1): a sequence that matches no state becomes one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smal.matching.products import Known
from smal.novelty import Match, NoveltyTest, describe_match
from smal.sequences import first_frame
from smal.state_matching import solve
from smal.template_store import TemplateStore

Progress = Callable[[int, int], None]

_BATCH = 32


@dataclass(frozen=True, eq=False)
class StateSpace:
    """What Algorithm 1 returns, and what it saw on the way.

    Parameters
    ----------
    templates : float32 array (m, n)
        X; state j is the columns j * l and following.
    streams : tuple of int32 arrays (f_d // l,)
        The paper's s-stream, one per demonstration.
    residuals, scores, total_weights, agreements : tuples of float32 arrays (f_d // l,)
        `Match` of every sequence before it was added.
    sequence_length : int
    """

    templates: NDArray[np.float32]
    streams: tuple[NDArray[np.int32], ...]
    residuals: tuple[NDArray[np.float32], ...]
    scores: tuple[NDArray[np.float32], ...]
    total_weights: tuple[NDArray[np.float32], ...]
    agreements: tuple[NDArray[np.float32], ...]
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

    def step(self, frames: NDArray[np.float32], correlations: NDArray[np.float32]) -> tuple[int, Match]:
        """Match one sequence (l, m) with correlations (n, l), or add it: its state, and the match."""
        match, store, length = Match(None, 0.0, 0.0, 1.0, 0.0), self.store, self.parameters[0]
        if len(store):
            solution = solve(store.templates, frames.T, *self.parameters, Known(correlations, store.gram))
            match = describe_match(solution, lambda columns: correlations[columns], np.linalg.norm(frames, axis=1))
        if match.state is None or self.test.is_novel(match):
            store.append(frames, correlations)
            return len(store) // length - 1, match
        return match.state, match


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
    results: list[tuple[int, Match]] = []
    for batch in _batches(demonstrations, sequence_length):
        _learn_batch(learner, batch, results)
        if progress is not None:
            progress(len(results), sum(counts))
    ends = np.cumsum(counts)[:-1]

    def per_demonstration(values: list[float]) -> tuple[NDArray[np.float32], ...]:
        return tuple(np.split(np.array(values, dtype=np.float32), ends))

    return StateSpace(
        store.templates,
        tuple(np.split(np.array([state for state, _ in results], dtype=np.int32), ends)),
        per_demonstration([match.residual for _, match in results]),
        per_demonstration([match.score for _, match in results]),
        per_demonstration([match.total_weight for _, match in results]),
        per_demonstration([match.agreement for _, match in results]),
        sequence_length,
    )


def _learn_batch(learner: _Learner, batch: NDArray[np.float32], results: list[tuple[int, Match]]) -> None:
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
        results.append(learner.step(sequence, np.ascontiguousarray(known[:count, columns])))
        if len(store) > count:
            known[count : len(store)] = among[columns]
