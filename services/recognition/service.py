"""One observation in, one state out."""

from __future__ import annotations

from pathlib import Path

from schemas.observation import Observation
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import Candidate, State
from services.process import Detail, ServiceError
from smal.execution import Recognizer
from smal.model import Model, ModelError


class RecognitionService:
    """Keeps the window of recent frames and recognises the state whenever a decision is due."""

    def __init__(self) -> None:
        self._recognizer: Recognizer | None = None
        self._model: Model | None = None
        self._path = ""
        self._stride = 0
        self._last: State | None = None

    def load(self, request: LoadRequest) -> LoadReply:
        """Load a model.

        Raises
        ------
        ServiceError
            When the file is no model.
        """
        try:
            model = Model.load(Path(request.path))
        except ModelError as error:
            raise ServiceError(str(error)) from None
        self._stride = request.stride or model.sequence_length
        self._recognizer = Recognizer(model)
        self._model, self._path, self._last = model, request.path, None
        return LoadReply(
            states=model.states,
            templates=model.templates.shape[1],
            sequence_length=model.sequence_length,
            stride=self._stride,
        )

    def handle(self, observation: Observation) -> State:
        """Return the state at one frame; ``collecting`` where no decision is due.

        Raises
        ------
        ServiceError
            When the observation was made with other features than the model.
        """
        if self._recognizer is None or self._model is None:
            return State.after(observation, status="idle")
        wanted = self._model.feature_settings.fingerprint
        if observation.fingerprint != wanted:
            raise ServiceError(
                f"observations have the features {observation.fingerprint}, the model {wanted}; learn the model again"
            )
        last = self._last
        if last is not None and last.episode == observation.episode and last.tick == observation.tick:
            # The simulator sent the frame again because an answer was lost: the same answer, the window unchanged.
            return last
        if last is None or last.episode != observation.episode:
            self._recognizer.reset()
        # The first decision is due with the first whole window, the others follow at equal distances.
        due = (observation.tick + 1 - self._model.sequence_length) % self._stride == 0
        found = self._recognizer.observe(observation.tick, observation.features.to_numpy(), due)
        self._last = State.after(
            observation,
            status=found.status,
            state=found.state,
            phase=found.phase,
            score=found.score,
            total_weight=found.total_weight,
            residual=found.residual,
            agreement=found.agreement,
            duality_gap=found.duality_gap,
            candidates=tuple(Candidate(state=c.state, phase=c.phase, weight=c.weight) for c in found.candidates),
        )
        return self._last

    def detail(self) -> Detail:
        """Tell the loaded model."""
        if self._model is None:
            return {"model": None}
        return {"model": self._path, "states": self._model.states, "stride": self._stride}
