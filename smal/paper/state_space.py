"""State space learning (paper, Algorithm 1): a sequence that matches no state becomes one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from smal.arrays import Float32s, Int32s
from smal.paper.novelty import describe_match
from smal.paper.sequences import first_frame
from smal.paper.state_matching import solve

Progress = Callable[[int, int], None]


class MemoryBoundError(MemoryError):
    """The templates need more memory than the limit."""


@dataclass(frozen=True, eq=False)
class StateSpace:
    """Result of Algorithm 1: X (m, n), state j in l columns from j l on, and s-streams of states, (f // l,)."""

    templates: Float32s
    streams: tuple[Int32s, ...]
    sequence_length: int

    @property
    def states(self) -> int:
        """Number of states."""
        return int(self.templates.shape[1]) // self.sequence_length


def learn_state_space(
    demonstrations: Sequence[Float32s],
    sequence_length: int,
    lambdas: tuple[float, float],
    tau: float,
    tolerance: float = 1e-3,
    max_bytes: int | None = None,
    progress: Progress | None = None,
) -> StateSpace:
    """Divide demonstrations into sequences of l frames, and build the states (Section III-B).

    Parameters
    ----------
    demonstrations
        Centred features (f, m) of unit length.
    lambdas
        Weights of the two regularizers of Eq. 7.
    tau
        Threshold of Eq. 8, per query frame.
    tolerance
        Relative duality gap of each match.
    max_bytes
        Maximum of the templates: n frames of m features take 4 n m bytes.

    Raises
    ------
    ValueError
        If no demonstration has l frames.
    MemoryBoundError
        If the templates need more than `max_bytes`.
    """
    l = sequence_length  # noqa: E741
    sequences = [
        frames[start : start + l]
        for frames in demonstrations
        for start in range(first_frame(len(frames), l), len(frames), l)
    ]
    if not sequences:
        raise ValueError(f"no demonstration has {l} frames")
    # There are at most as many states as sequences; memory is allocated when a row is written.
    rows = np.empty((len(sequences) * l, sequences[0].shape[1]), dtype=np.float32)
    stream: list[int] = []
    states = 0
    for frames in sequences:
        templates = rows[: states * l].T
        state = _known_state(templates, frames, lambdas, tau, tolerance)
        if state is None:
            state = states
            states += 1
            if max_bytes is not None and states * frames.nbytes > max_bytes:
                raise MemoryBoundError(
                    f"the templates need more than {max_bytes / 2**20:.1f} MiB allowed; "
                    "allow more, or merge more states by a smaller tau"
                )
            rows[state * l : states * l] = frames
        stream.append(state)
        if progress is not None:
            progress(len(stream), len(sequences))
    ends = np.cumsum([len(frames) // l for frames in demonstrations])[:-1]
    streams = np.split(np.array(stream, dtype=np.int32), ends)
    return StateSpace(rows[: states * l].T, tuple(streams), l)


def _known_state(
    templates: Float32s,
    frames: Float32s,
    lambdas: tuple[float, float],
    tau: float,
    tolerance: float,
) -> int | None:
    """Return the state of a sequence (l, m); None if it is novel (Eq. 8)."""
    if not templates.size:
        return None
    solution = solve(templates, frames.T, len(frames), *lambdas, tolerance)
    match = describe_match(solution, templates, frames)
    return None if match.is_novel(tau) else match.state
