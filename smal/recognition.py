"""Execution, first half: from camera frames to a state."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from smal.model import Model
from smal.novelty import describe_match
from smal.state_matching import Solution
from smal.state_space import matched_phase
from smal.streaming import StreamingMatcher, compile_ahead

# Lighter candidates hold a few hundredths of the weight together.
MAX_CANDIDATES = 32


@dataclass(frozen=True)
class Candidate:
    """A state that the last l frames may show.

    Parameters
    ----------
    state : int
    phase : float
        Frame of its template at which the last frame is (`smal.state_space.phase`).
    weight : float
        Its share of the positive weights of W, above 0 and at most 1.
    """

    state: int
    phase: float
    weight: float


@dataclass(frozen=True)
class Recognition:
    """Which state the last l frames show.

    Parameters
    ----------
    status : str
        "collecting": there are no l frames yet, or no answer was due; "recognized"; or "unknown": the frames
        show nothing that was taught.
    tick : int
        Of the last frame.
    state : int or None
        Only if recognized.
    phase : float or None
        Frame of the state's template at which the last frame is (`smal.state_space.phase`); only if recognized.
    score, total_weight, residual, agreement : float
        See `smal.novelty.Match`; 0, 0, 1, 0 while collecting.
    duality_gap : float
        Of the match.
    candidates : tuple of Candidate
        All states with weight, heaviest first: a belief over states. Empty stands for certainty about `state`.
    """

    status: Literal["collecting", "recognized", "unknown"]
    tick: int
    state: int | None = None
    phase: float | None = None
    score: float = 0.0
    total_weight: float = 0.0
    residual: float = 1.0
    agreement: float = 0.0
    duality_gap: float = 0.0
    candidates: tuple[Candidate, ...] = ()


class Recognizer:
    """Keeps the last l frames and matches them with the states of a model.

    The correlations of a frame with all templates are computed when it arrives, so that after the last frame
    of a sequence one matrix-vector product and a small solve remain.

    Parameters
    ----------
    model : Model
    tolerance : float
        Relative duality gap of each match.
    """

    def __init__(self, model: Model, tolerance: float = 1e-3) -> None:
        self._model = model
        self._centering = model.centering
        self._test = model.recognition_test()
        compile_ahead()
        self._matcher = StreamingMatcher(
            model.templates, model.sequence_length, model.lambda1, model.lambda2, tolerance
        )
        self.reset()

    def reset(self) -> None:
        """Forget all frames, for a new episode."""
        self._matcher.reset()
        self._last_tick: int | None = None

    def observe(self, tick: int, raw_features: NDArray[Any], due: bool) -> Recognition:
        """Take one frame.

        Parameters
        ----------
        tick : int
            Frame number in the episode. Unless it follows the last one, the window starts anew: a sequence
            never spans a dropped frame.
        raw_features : array (m,)
            From `smal.features.extract`.
        due : bool
            Whether an answer is wanted; otherwise the frame is only taken in.

        Raises
        ------
        ValueError
            Features of the wrong length, NaN or infinity; the frame is then not taken in.
        """
        if raw_features.ndim != 1:
            raise ValueError(f"features of one frame must have the shape (m,), got {raw_features.shape}")
        features = self._centering.apply(raw_features)
        if self._last_tick is not None and tick != self._last_tick + 1:
            self.reset()
        self._last_tick = tick
        self._matcher.observe(features)
        if not due or not self._matcher.ready:
            return Recognition("collecting", tick)
        return self._recognize(tick)

    def _recognize(self, tick: int) -> Recognition:
        solution, window = self._matcher.match(), self._matcher.window()
        templates = self._model.templates
        match = describe_match(
            solution, lambda frames: templates[:, frames].T @ window.T, np.linalg.norm(window, axis=1)
        )
        known = match.state is not None and not self._test.is_novel(match)
        return Recognition(
            status="recognized" if known else "unknown",
            tick=tick,
            state=match.state if known else None,
            phase=matched_phase(solution, match.state) if known and match.state is not None else None,
            score=match.score,
            total_weight=match.total_weight,
            residual=match.residual,
            agreement=match.agreement,
            duality_gap=solution.duality_gap,
            candidates=_candidates(solution) if known else (),
        )


def _candidates(solution: Solution) -> tuple[Candidate, ...]:
    """States by their share of the positive weights; a negative weight is no evidence for a state."""
    blocks, where = np.unique(solution.active // solution.sequence_length, return_inverse=True)
    weights = np.bincount(where, np.maximum(solution.active_weights, 0.0).sum(axis=1))
    total = float(weights.sum())
    heaviest = [i for i in np.argsort(-weights, kind="stable") if weights[i] > 0.0][:MAX_CANDIDATES]
    return tuple(
        Candidate(int(blocks[i]), matched_phase(solution, int(blocks[i])), float(weights[i]) / total) for i in heaviest
    )
