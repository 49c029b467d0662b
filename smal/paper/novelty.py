"""When does a query sequence match a known state? One small class per answer.

`WeightTest` is the paper's (Eq. 8). It has a flaw that shows with several demonstrations of one route: sequences that
resemble each other share the weight, so that the best one has less the more there are, and the threshold depends on
the number of templates. `AgreementTest` asks two questions that do not depend on it: do the templates together
explain the query, and does the best sequence alone look like it?
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from smal.paper.state_matching import Solution

#: Views whose cosine is nearer to 1 are the same image, but for the rounding of float32.
_REPEATED = 1e-6


@dataclass(frozen=True)
class Match:
    """What the tests look at.

    Parameters
    ----------
    state : int or None
        Best template sequence (Eq. 9), None when W is zero.
    score : float
        Its weight for each of the q query frames, at least 0 (left side of Eq. 8, divided by q).
    total_weight : float
        Weight of all sequences per query frame.
    residual : float
        sum ||y_i - X w_i|| / sum ||y_i||, 0 (explained) to 1 (W = 0).
    agreement : float
        Mean over the query frames of the largest cosine with a frame of the best sequence, -1 to 1.
    """

    state: int | None
    score: float
    total_weight: float
    residual: float
    agreement: float


def describe_match(
    solution: "Solution", correlate: Callable[[slice], NDArray[Any]], query_norms: NDArray[Any]
) -> Match:
    """Summarize a solution.

    Parameters
    ----------
    solution : Solution
    correlate : callable
        X_S^T Y (l, q) of adjacent template frames S, of unit length.
    query_norms : array (q,)
        ||y_i||.
    """
    length = solution.sequence_length
    total = float(query_norms.sum(dtype=np.float64))
    residual = float(solution.residual_norms.sum()) / total if total > 0.0 else 1.0
    weights, state = solution.block_weights, solution.best_block
    if state is None:
        return Match(None, 0.0, 0.0, min(residual, 1.0), 0.0)
    best = correlate(slice(state * length, (state + 1) * length)).max(axis=0)
    cosines = np.divide(best, query_norms, out=np.zeros(query_norms.size), where=query_norms > 0.0)
    q = query_norms.size
    return Match(state, float(weights.max()) / q, float(weights.sum()) / q, min(residual, 1.0), float(cosines.mean()))


class NoveltyTest(Protocol):
    """Decides whether a query sequence shows something that no template sequence shows."""

    def is_novel(self, match: Match) -> bool:
        """Return True if the query matches no template sequence."""


@dataclass(frozen=True)
class WeightTest:
    """Eq. 8: no sequence has a weight above tau.

    Parameters
    ----------
    tau : float
        Per query frame, so that it need not change with l; the paper's tau is tau * l.
    """

    tau: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.tau) and self.tau >= 0.0):
            raise ValueError(f"tau must be finite and not negative, got {self.tau}")

    def is_novel(self, match: Match) -> bool:
        """Compare the best weight; all others are smaller."""
        return match.state is None or match.score <= self.tau


@dataclass(frozen=True)
class AgreementTest:
    """The templates together leave too much unexplained, or the best sequence alone does not look like the query.

    Parameters
    ----------
    max_residual : float
        Largest share of the query that may stay unexplained, 0 to 1.
    min_agreement : float
        Smallest mean cosine with the best sequence, -1 to 1; learning takes it from the demonstrations
        (`neighbour_agreement`) unless it is given.
    """

    max_residual: float = 0.75
    min_agreement: float = 0.9

    def __post_init__(self) -> None:
        if not (0.0 <= self.max_residual <= 1.0 and -1.0 <= self.min_agreement <= 1.0):
            raise ValueError(
                f"max_residual must be 0 to 1 and min_agreement -1 to 1, got {self.max_residual}, {self.min_agreement}"
            )

    def is_novel(self, match: Match) -> bool:
        """Apply both limits."""
        return match.state is None or match.residual > self.max_residual or match.agreement < self.min_agreement


def neighbour_agreement(demonstrations: Sequence[NDArray[np.float32]], moving: Sequence[NDArray[np.bool_]]) -> float:
    """Measure how much a frame resembles the next one while the robot moves.

    Two views should count as the same state if they are about as near as one frame's movement, and how much such views
    resemble each other depends on camera, noise, speed and surroundings. The upper quartile is taken: the small
    movements, since a turn on the spot changes a view more than any displacement that an action would survive.

    Frames that repeat the one before do not count: a camera slower than the ticks, or a robot that pushes against a
    wall, would make only equal views the same state.

    Parameters
    ----------
    demonstrations : sequence of float32 arrays (f, m)
        Centred features, unit length.
    moving : sequence of bool arrays (f,)
        Whether the robot moved between frame k and k + 1.

    Returns
    -------
    float
        Cosine, -1 to 1.

    Raises
    ------
    ValueError
        The robot never moved, or no view ever changed.
    """
    cosines = [
        np.einsum("fm,fm->f", frames[:-1], frames[1:], dtype=np.float64)[moves[:-1]]
        for frames, moves in zip(demonstrations, moving, strict=True)
    ]
    every = np.concatenate(cosines)
    if not every.size:
        raise ValueError("the robot does not move in any demonstration")
    changed = every[every < 1.0 - _REPEATED]
    if not changed.size:
        raise ValueError("what the camera shows does not change in any demonstration")
    return float(np.quantile(changed, 0.75))


NOVELTY_TESTS: dict[str, type[WeightTest] | type[AgreementTest]] = {"weight": WeightTest, "agreement": AgreementTest}


def novelty_test(name: str, parameters: dict[str, float]) -> WeightTest | AgreementTest:
    """Make a test by name; parameters that are not given have their defaults."""
    if name not in NOVELTY_TESTS:
        raise ValueError(f"unknown novelty test {name!r}; known are {sorted(NOVELTY_TESTS)}")
    try:
        return NOVELTY_TESTS[name](**parameters)
    except TypeError as error:
        raise ValueError(f"the novelty test {name!r} has no such parameter: {error}") from error
