"""Execution, first half: from camera frames to a state."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from smal.alignment import RECENCY_TICKS, DemonstratedOrder, matched_phase, phase, recency, relative_likelihood
from smal.matching.streaming import StreamingMatcher, compile_ahead
from smal.model import Model
from smal.novelty import describe_match
from smal.state_matching import Solution

# Lighter candidates hold a few hundredths of the weight together.
MAX_CANDIDATES = 32
#: Frames in a row for which the view may be hidden, by what passes, while what was seen before still tells the state.
HIDDEN_TICKS = 3
# A candidate with a smaller share of the belief has no say that anybody would notice.
_NEGLIGIBLE = 1e-4


@dataclass(frozen=True)
class Candidate:
    """A state that the last l frames may show.

    Parameters
    ----------
    state : int
    phase : float
        Frame of its template at which the last frame is (`smal.alignment`).
    weight : float
        Its share of the belief, above 0 and at most 1: of the positive weights of W, those of recent frames counting
        more, times the likelihood of the last frames there (`smal.alignment`).
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
        "collecting": the episode has no l frames yet, or no answer was due; "recognized"; or "unknown": the
        frames show nothing that was taught.
    tick : int
        Of the last frame.
    state : int or None
        The one of Eq. 9, with the largest weight; only if recognized. That of the first candidate may be another.
    phase : float or None
        Frame of the state's template at which the last frame is (`smal.alignment`); only if recognized.
    score, total_weight, residual, agreement : float
        See `smal.novelty.Match`; 0, 0, 1, 0 while collecting.
    duality_gap : float
        Of the match.
    candidates : tuple of Candidate
        States with positive weight, heaviest first, but for negligible ones: a belief over states at the last frame.
        Without any, `state` is certain.
    frames : int
        How many of the last frames this rests on: l, or fewer where those l are unknown (`Recognizer`).
    explained : float
        How much templates explain of these frames, the mean with recent ones counting more: 1 all of it, 0 if they
        alone would count as novel. 1 too where that is not known: with `shorten=False`, with a novelty test that does
        not tell frames apart, and unless there are candidates.
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
    frames: int = 0
    explained: float = 1.0


class Recognizer:
    """Keeps the last l frames and matches them with the states of a model.

    The correlations of a frame with all templates are computed when it arrives, so that after the last frame
    of a sequence one matrix-vector product and a small solve remain.

    Where the last l frames show nothing that was taught, the last l / 2 are tried, l / 4 and so on to one: a robot that
    has looked around, or has left the taught way for a moment, would otherwise have to drive l taught frames
    before it knows again where it is. The same where a frame was lost on the way, and fewer than l have come since.

    The less templates explain of a frame, since something hides the view, the less it has to say in where the robot is;
    and where the last `HIDDEN_TICKS` and one more are not explained at all, nothing is known.

    Parameters
    ----------
    model : Model
    tolerance : float
        Relative duality gap of each match.
    recency_ticks : float
        See `smal.alignment.RECENCY_TICKS`, above 0; infinite for all frames of the window alike.
    shorten : bool
        Whether shorter windows are tried, and hidden frames are left out; the paper's scheme does neither.

    Raises
    ------
    ValueError
        recency_ticks out of range.
    """

    def __init__(
        self, model: Model, tolerance: float = 1e-3, recency_ticks: float = RECENCY_TICKS, shorten: bool = True
    ) -> None:
        if not recency_ticks > 0.0:
            raise ValueError(f"recency_ticks must be above 0, got {recency_ticks}")
        self._recency_ticks = recency_ticks
        self._demonstrated = DemonstratedOrder(model.state_streams, model.phases, model.sequence_length)
        self._shorten = shorten
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
        self._interrupted = False

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
            self._matcher.reset()
            self._interrupted = True
        self._last_tick = tick
        self._matcher.observe(features)
        enough = self._matcher.ready or (self._interrupted and self._shorten)
        return self._recognize(tick) if due and enough else Recognition("collecting", tick)

    def _recognize(self, tick: int) -> Recognition:
        frames = self._model.sequence_length
        while frames > self._matcher.held:
            frames //= 2
        found = self._recognize_last(frames, tick)
        while self._shorten and found.status == "unknown" and frames > 1:
            frames //= 2
            shorter = self._recognize_last(frames, tick)
            if shorter.status == "recognized":
                return shorter
        return found

    def _recognize_last(self, frames: int, tick: int) -> Recognition:
        """Recognise the last frames, 1 to l."""
        solution, window = self._matcher.match(frames), self._matcher.window(frames)
        templates, norms = self._model.templates, np.linalg.norm(window, axis=1)
        match = describe_match(solution, lambda columns: templates[:, columns].T @ window.T, norms)
        found = Recognition(
            status="unknown",
            tick=tick,
            score=match.score,
            total_weight=match.total_weight,
            residual=match.residual,
            agreement=match.agreement,
            duality_gap=solution.duality_gap,
            frames=frames,
        )
        weights = recent = recency(frames, self._recency_ticks)
        if self._shorten:
            weights = recent * self._test.explained(solution.residual_norms, norms)
        if not weights[-1 - HIDDEN_TICKS :].any():
            return found
        candidates = _candidates(solution, weights)
        # What resembles nothing but the opposite of something has no candidates.
        if match.state is None or not candidates or self._test.is_novel(match):
            return found
        where = self._demonstrated.align(
            [match.state, *(one.state for one in candidates)],
            [matched_phase(solution, match.state), *(one.phase for one in candidates)],
            weights,
            self._matcher.correlations,
        )
        return replace(
            found,
            status="recognized",
            state=match.state,
            phase=float(where.phases[0]),
            candidates=_belief(candidates, where.phases[1:], where.similarity[1:]),
            explained=min(float(weights.sum() / recent.sum()), 1.0),
        )


def _candidates(solution: Solution, frame_weights: NDArray[np.float64]) -> tuple[Candidate, ...]:
    """States by their share of the positive weights; a negative weight is no evidence for a state.

    Frames count by their weights (q,), in the phase too.
    """
    length, q = solution.sequence_length, solution.shape[1]
    present = np.maximum(solution.active_weights, 0.0) * frame_weights
    blocks, where = np.unique(solution.active // length, return_inverse=True)
    weights = np.bincount(where, present.sum(axis=1))
    total = float(weights.sum())
    heaviest = [i for i in np.argsort(-weights, kind="stable") if weights[i] > 0.0][:MAX_CANDIDATES]
    found = []
    for i in heaviest:
        block = np.zeros((length, q))
        block[solution.active[where == i] % length] = present[where == i]
        found.append(Candidate(int(blocks[i]), phase(block), float(weights[i]) / total))
    return tuple(found)


def _belief(
    candidates: tuple[Candidate, ...], phases: NDArray[np.float64], similarity: NDArray[np.float64]
) -> tuple[Candidate, ...]:
    """Take in where candidates are, and how likely that is."""
    weights = np.array([one.weight for one in candidates]) * relative_likelihood(similarity)
    weights /= weights.sum()
    order = [i for i in np.argsort(-weights, kind="stable") if weights[i] > _NEGLIGIBLE]
    return tuple(Candidate(candidates[i].state, float(phases[i]), float(weights[i])) for i in order)
