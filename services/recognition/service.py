"""One observation in, one state out."""

from __future__ import annotations

from collections.abc import Callable

from schemas.observation import Observation
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import Candidate, State
from services.model_service import LoadedModel
from services.process import Detail, ServiceError
from smal.recognition import Recognizer


class RecognitionService:
    """Keeps the window of recent frames and recognises the state whenever a decision is due.

    A frame that another one already waits behind is taken in only: answering it would make the newest answer later, and
    the policy goes on with its plan meanwhile. In lockstep there is none.
    """

    def __init__(self) -> None:
        #: Whether newer observations wait.
        self.behind: Callable[[], bool] = lambda: False
        self._loaded: LoadedModel | None = None
        self._recognizer: Recognizer | None = None
        self._last: State | None = None

    def load(self, request: LoadRequest) -> LoadReply:
        """Load a model; the one before stays when it is refused.

        Raises
        ------
        ServiceError
            When the file is no model, or the stride is longer than its sequences.
        """
        loaded = LoadedModel.read(request)
        recognizer = Recognizer(loaded.model)
        self._loaded, self._recognizer, self._last = loaded, recognizer, None
        return loaded.reply()

    def handle(self, observation: Observation) -> State:
        """Return the state at one frame; ``collecting`` where no decision is due.

        Raises
        ------
        ServiceError
            When the observation was made with other features than the model.
        """
        if self._recognizer is None or self._loaded is None:
            return State.after(observation, status="idle")
        model = self._loaded.model
        wanted = model.feature_settings.fingerprint
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
        due = (observation.tick + 1 - model.sequence_length) % self._loaded.stride == 0 and not self.behind()
        found = self._recognizer.observe(observation.tick, observation.features.to_numpy(), due)
        self._last = State.after(
            observation,
            status=found.status,
            model=self._loaded.identity,
            state=found.state,
            phase=found.phase,
            score=found.score,
            total_weight=found.total_weight,
            residual=found.residual,
            agreement=found.agreement,
            duality_gap=found.duality_gap,
            explained=found.explained,
            candidates=tuple(Candidate(state=c.state, phase=c.phase, weight=c.weight) for c in found.candidates),
        )
        return self._last

    def detail(self) -> Detail:
        """Tell the loaded model."""
        # This runs on a thread of the bus: the model may be replaced at any time.
        loaded = self._loaded
        return {"model": None} if loaded is None else loaded.detail()
