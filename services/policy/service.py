"""One state in; a decision where one is due, and always a command, out."""

from __future__ import annotations

from pathlib import Path

from schemas.action import Action
from schemas.base import Message
from schemas.command import Command
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import State
from services.process import Detail, ServiceError
from smal.execution import Candidate, DecisionMaker, Recognition
from smal.model import Model, ModelError


class PolicyService:
    """Decides when recognition has an answer, and sends one atom movement for every frame."""

    def __init__(self) -> None:
        self._maker: DecisionMaker | None = None
        self._path = ""
        self._stride = 0
        self._last: tuple[State, list[Message]] | None = None

    def load(self, request: LoadRequest) -> LoadReply:
        """Load a model.

        Raises
        ------
        ServiceError
            When the file is no model, or the stride is longer than its sequences.
        """
        try:
            model = Model.load(Path(request.path))
            self._stride = request.stride or model.sequence_length
            self._maker = DecisionMaker(model, self._stride)
        except (ModelError, ValueError) as error:
            raise ServiceError(str(error)) from None
        self._path, self._last = request.path, None
        return LoadReply(
            states=model.states,
            templates=model.templates.shape[1],
            sequence_length=model.sequence_length,
            stride=self._stride,
        )

    def handle(self, state: State) -> list[Message]:
        """Return the decision, if one is due at this frame, and the command for it."""
        if self._maker is None or state.status == "idle":
            return []
        if self._last is not None:
            last, answer = self._last
            if (last.episode, last.tick) == (state.episode, state.tick):
                # The simulator asked again because an answer was lost: the same answer, the plan unchanged.
                return answer
            if last.episode != state.episode:
                self._maker.reset()
        answer = []
        if state.status != "collecting":
            decision = self._maker.decide(
                Recognition(
                    status=state.status,
                    tick=state.tick,
                    state=state.state,
                    phase=state.phase,
                    score=state.score,
                    total_weight=state.total_weight,
                    residual=state.residual,
                    agreement=state.agreement,
                    duality_gap=state.duality_gap,
                    candidates=tuple(Candidate(c.state, c.phase, c.weight) for c in state.candidates),
                )
            )
            atoms = tuple(atom.name.lower() for atom in decision.atoms)
            answer.append(Action.after(state, kind=decision.kind, state=state.state, atoms=atoms))
        atom = self._maker.next_atom().name.lower()
        answer.append(Command.after(state, source="policy", atom=atom))
        self._last = (state, answer)
        return answer

    def detail(self) -> Detail:
        """Tell the loaded model."""
        return {"model": self._path or None, "stride": self._stride or None}
