"""Match of a query sequence with a known state, or its novelty (paper, Eq. 8)."""

from dataclasses import dataclass

import numpy as np

from smal.arrays import AnyArray
from smal.paper.state_matching import Solution


@dataclass(frozen=True)
class Match:
    """Match of a query with the templates.

    Attributes
    ----------
    state
        The best sequence (Eq. 9); None if W is zero.
    score, total_weight
        Its weight for each of the q query frames (left side of Eq. 8, divided by q), and the weight of all sequences.
    residual
        sum ||y_i - X w_i|| / sum ||y_i||, 0 (explained) to 1 (W = 0).
    agreement
        Mean over the query frames of the largest cosine with a frame of the best sequence, -1 to 1.
    """

    state: int | None
    score: float
    total_weight: float
    residual: float
    agreement: float

    def is_novel(self, tau: float) -> bool:
        """Return whether no sequence has a weight above tau (Eq. 8).

        Here tau is per query frame; the paper's tau is tau * l. With several demonstrations of one route, similar
        sequences share the weight, so that the best sequence has less weight.
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
    score = float(weights.max()) / q
    total_weight = float(weights.sum()) / q
    return Match(state, score, total_weight, residual, float(cosines.mean()))
