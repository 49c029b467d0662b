"""When does a query sequence match a known state (paper, Eq. 8), and what else W says of it."""

from dataclasses import dataclass

import numpy as np

from smal.arrays import AnyArray
from smal.paper.state_matching import Solution


@dataclass(frozen=True)
class Match:
    """How well a query matches the templates; `state` is the best sequence (Eq. 9), None where W is zero.

    `score` is its weight for each of the q query frames (left side of Eq. 8, divided by q), `total_weight` that of all.
    `residual` is sum ||y_i - X w_i|| / sum ||y_i||, 0 (explained) to 1 (W = 0); `agreement` the mean over the query
    frames of the largest cosine with a frame of the best sequence, -1 to 1.
    """

    state: int | None
    score: float
    total_weight: float
    residual: float
    agreement: float

    def is_novel(self, tau: float) -> bool:
        """Eq. 8: no sequence has a weight above tau, which is per query frame here; the paper's tau is tau * l.

        With several demonstrations of one route, sequences that resemble each other share the weight: the best one
        has less the more there are.
        """
        return self.state is None or self.score <= tau


def describe_match(solution: Solution, templates: AnyArray, frames: AnyArray) -> Match:
    """Summarize a solution of Eq. 7, of templates X (m, n) of unit length and frames Y^T (q, m)."""
    length = solution.sequence_length
    q = len(frames)
    norms = np.linalg.norm(frames, axis=1)
    total = float(norms.sum(dtype=np.float64))
    residual = min(float(solution.residual_norms.sum()) / total, 1.0) if total > 0.0 else 1.0
    weights = solution.block_weights
    state = solution.best_block
    if state is None:
        return Match(None, 0.0, 0.0, residual, 0.0)
    best = (frames @ templates[:, state * length : (state + 1) * length]).max(axis=1)
    cosines = np.divide(best, norms, out=np.zeros(q), where=norms > 0.0)
    return Match(
        state, float(weights.max()) / q, float(weights.sum()) / q, residual, float(cosines.mean())
    )
