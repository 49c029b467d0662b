"""The paper's execution, first half: from camera frames to a state (Eq. 7 and 9)."""

from collections import deque

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.paper.execution import Recognition, Status
from smal.paper.model import PaperModel
from smal.paper.novelty import describe_match
from smal.paper.state_matching import solve


class Recognizer:
    """Matches the last l frames with the states of a model, each time to a relative duality gap."""

    def __init__(self, model: PaperModel, tolerance: float = 1e-3) -> None:
        self._model = model
        self._centering = model.centering
        self._templates = np.asfortranarray(model.templates, dtype=np.float32)
        self._parameters = model.sequence_length, model.lambda1, model.lambda2, tolerance
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._frames: deque[Float32s] = deque(maxlen=self._model.sequence_length)
        self._last_tick: int | None = None

    def observe(self, tick: int, raw_features: AnyArray, due: bool) -> Recognition:
        """Process the raw features (m,) of one frame, and recognize the state if a decision is due.

        A dropped frame restarts the window, so that a sequence is always complete. Features of the wrong length, NaN or
        infinity raise ValueError, and the frame is ignored.
        """
        if raw_features.ndim != 1:
            raise ValueError(
                f"features of one frame must have the shape (m,), got {raw_features.shape}"
            )
        features = self._centering.apply(raw_features)
        if self._last_tick is not None and tick != self._last_tick + 1:
            self._frames.clear()
        self._last_tick = tick
        self._frames.append(features)
        if not due or len(self._frames) < self._model.sequence_length:
            return Recognition("collecting", tick)
        frames = np.stack(self._frames)
        solution = solve(self._templates, frames.T, *self._parameters)
        match = describe_match(solution, self._templates, frames)
        status: Status = "unknown" if match.state is None else "recognized"
        return Recognition(status, tick, duality_gap=solution.duality_gap, **vars(match))
