"""One state in; a decision where one is due, and always a command, out."""

from __future__ import annotations

import logging

from schemas.action import Action
from schemas.base import Message
from schemas.command import Command
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import State
from services.model_service import LoadedModel
from services.process import Detail, Throttle
from smal.decision import DecisionMaker
from smal.recognition import Candidate, Recognition

_log = logging.getLogger("policy")


class PolicyService:
    """Decides when recognition has an answer, and sends one atom movement for every frame.

    A state of another model than its own means something else here: the robot stops, and the plan is dropped.
    """

    def __init__(self) -> None:
        self._loaded: LoadedModel | None = None
        self._maker: DecisionMaker | None = None
        self._last: tuple[State, list[Message]] | None = None
        self._foreign = 0
        self._complaints = Throttle()

    def load(self, request: LoadRequest) -> LoadReply:
        """Load a model; the one before stays when it is refused.

        Raises
        ------
        ServiceError
            When the file is no model, or the stride is longer than its sequences.
        """
        loaded = LoadedModel.read(request)
        maker = DecisionMaker(loaded.model, loaded.stride)
        self._loaded, self._maker, self._last, self._foreign = loaded, maker, None, 0
        return loaded.reply()

    def handle(self, state: State) -> list[Message]:
        """Return the decision, if one is due at this frame, and the command for it."""
        if self._loaded is None or self._maker is None or state.status == "idle":
            return []
        if state.model != self._loaded.identity:
            return [self._refuse(state, self._loaded, self._maker)]
        if self._last is not None:
            last, answer = self._last
            if (last.episode, last.tick) == (state.episode, state.tick):
                # The simulator asked again because an answer was lost: the same answer, the plan unchanged.
                return answer
            if last.episode != state.episode:
                self._maker.reset()
        answer = _answer(state, self._maker)
        self._last = (state, answer)
        return answer

    def _refuse(self, state: State, loaded: LoadedModel, maker: DecisionMaker) -> Command:
        """Stop, and have nothing left to do when the states are of the right model again."""
        maker.reset()
        self._last = None
        self._foreign += 1
        if self._complaints.due():
            _log.warning(
                "stopping: recognition has model %s, policy has %s (%s); load the same into both (%d states so far)",
                state.model, loaded.identity, loaded.path, self._foreign,
            )  # fmt: skip
        return Command.after(state, source="policy", atom="stop")

    def detail(self) -> Detail:
        """Tell the loaded model, and how many states were of another one since it was loaded."""
        # This runs on a thread of the bus: the model may be replaced at any time.
        loaded = self._loaded
        return {"model": None} if loaded is None else loaded.detail() | {"states_of_another_model": self._foreign}


def _answer(state: State, maker: DecisionMaker) -> list[Message]:
    answer: list[Message] = []
    if state.status in {"recognized", "unknown"}:
        decision = maker.decide(_recognition(state))
        atoms = tuple(atom.name.lower() for atom in decision.atoms)
        answer.append(Action.after(state, kind=decision.kind, state=decision.state, atoms=atoms))
    atom = maker.next_atom().name.lower()
    answer.append(Command.after(state, source="policy", atom=atom))
    return answer


def _recognition(state: State) -> Recognition:
    assert state.status != "idle"  # noqa: S101 - not answered at all
    return Recognition(
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
        explained=state.explained,
    )
