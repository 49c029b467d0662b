"""One state in; a decision where one is due, and always a command, out."""

import logging
import math
from collections import deque
from statistics import median
from typing import Final

from schemas.action import Action
from schemas.base import Message, Velocity
from schemas.command import Command, CommandApplied
from schemas.rpc import LoadReply
from schemas.state import State
from services.kit.belief import belief_of, glimpse_of
from services.kit.model_service import LoadedModel, Wheels
from services.kit.node import Detail
from services.kit.sight import ObstacleSight
from services.kit.throttle import Throttle
from smal.model import Model
from smal.paper.execution import DecisionMaker, Recognition
from smal.paper.model import PaperModel
from smal.planning import Planner

DELAYS_KEPT: Final = (
    10  # Reports of the actuator of whose delays the median is taken: those of a second.
)
SHOWN: Final = 100  # Places where something stands that are told with a decision, for people.
_log = logging.getLogger("policy")


class PolicyService:
    """Answers every frame with a command; if recognition has another model, it stops the robot and drops its plan.

    A model that is loaded is prepared here first, and taken with recognition's first state of it: until then it goes on
    by the one before, so that no robot stands between two maps.
    """

    def __init__(self) -> None:
        self._loaded: LoadedModel | None = None
        self._maker: _ByFilter | _ByPaper | None = None
        self._before: tuple[LoadedModel, _ByFilter | _ByPaper] | None = (
            None  # What recognition may still go by.
        )
        self._last: tuple[State, list[Message]] | None = None
        self._foreign = 0
        self._complaints = Throttle()
        self.sight = ObstacleSight()  # What stands about the robot; it goes round that.
        #: How long its commands take to move the robot, by what the actuator has told lately.
        self._delays_s: deque[float] = deque([0.0], maxlen=DELAYS_KEPT)

    def load(self, loaded: LoadedModel) -> LoadReply:
        """Work with another model, as soon as recognition does."""
        model = loaded.model
        if self._before is None and self._loaded is not None and self._maker is not None:
            self._before = self._loaded, self._maker
        if self._before is not None and self._before[0].identity == loaded.identity:
            self._before = None  # To another goal, or back: at once.
        maker = _ByFilter(model, loaded.goal) if isinstance(model, Model) else _ByPaper(model)
        self._loaded = loaded
        self._maker = maker
        self._last = None
        self._foreign = 0
        return loaded.reply()

    @property
    def loaded(self) -> LoadedModel | None:
        """The model that it works with."""
        return self._loaded

    def hands_on(self) -> None:
        """Return nothing: what it plans follows from the next state."""

    def resume(self, state: State, wheels: Wheels | None) -> None:
        """Plan anew."""

    def see_applied(self, applied: CommandApplied) -> None:
        """Take what the actuator tells of how long a command took."""
        if applied.source == "policy" and applied.delay_ns is not None:
            self._delays_s.append(applied.delay_ns / 1e9)

    def handle(self, state: State) -> list[Message]:
        """Return the decision, if one is due at this frame, and the command for it."""
        if self._loaded is None or self._maker is None or state.status == "idle":
            return []
        loaded = self._loaded
        maker = self._maker
        if self._before is not None and state.model == self._before[0].identity:
            loaded, maker = self._before
        elif state.model == loaded.identity:
            self._before = None
        decided = state.status in {"recognized", "unknown"}
        if state.model != loaded.identity or (decided and not maker.understands(state)):
            return [self._refuse(state, loaded, maker)]
        if self._last is not None:
            last, answer = self._last
            if (last.episode, last.tick) == (state.episode, state.tick):
                # The simulator asked again because an answer was lost: the same answer, the plan unchanged.
                return answer
            if last.episode != state.episode:
                maker.reset()
        answer = maker.answer(state, median(self._delays_s), self.sight)
        self._last = (state, answer)
        return answer

    def _refuse(self, state: State, loaded: LoadedModel, maker: "_ByFilter | _ByPaper") -> Command:
        """Stop, and have nothing left to do when the states are of the right model again."""
        maker.reset()
        self._last = None
        self._foreign += 1
        if self._complaints.due():
            why = f"recognition has model {state.model}, policy has {loaded.identity}; load the same into both"
            if state.model == loaded.identity:
                why = f"a state has no place in model {state.model}, of which it is; check who publishes states"
            _log.warning("stopping: %s (%s, %d states so far)", why, loaded.name, self._foreign)
        return Command.after(state, source="policy", atom="stop")

    def detail(self) -> Detail:
        """Tell the loaded model, and how many states were of another one since it was loaded."""
        # This runs on a thread of the bus: the model may be replaced at any time.
        loaded = self._loaded
        return (
            {"model": None}
            if loaded is None
            else loaded.detail() | {"states_of_another_model": self._foreign}
        )


class _ByFilter:
    """Steers along the taught way by a belief over places."""

    def __init__(self, model: Model, goal: str | None) -> None:
        self._planner = Planner(model.mapped, goal)
        self._keyframes = len(model.mapped.keyframes)
        self.reset()

    def understands(self, state: State) -> bool:
        return len(state.keyframes) > 0 and state.keyframes.max() < self._keyframes

    def reset(self) -> None:
        self._planner.reset()
        self._stamp_ns: int | None = None

    def answer(self, state: State, delay_s: float, sight: ObstacleSight) -> list[Message]:
        elapsed_s = (
            None if self._stamp_ns is None else max(state.stamp_ns - self._stamp_ns, 0) / 1e9
        )
        self._stamp_ns = state.stamp_ns
        around = sight.around(state.episode)
        strange = math.inf if state.strange_m is None else state.strange_m
        decision = self._planner.decide(
            belief_of(state), elapsed_s, delay_s, glimpse_of(state), around, strange
        )
        velocity = Velocity(*decision.motion)
        known = int(state.keyframes[0]) if state.status == "recognized" else None
        things = () if around is None else tuple(map(tuple, around.things(SHOWN).round(2).tolist()))
        return [
            Action.after(
                state,
                kind=decision.kind,
                state=known,
                atoms=(velocity.atom(),),
                arrived=self._planner.arrived,
                says=self._planner.said,
                obstacles=things,
            ),
            Command.after(state, source="policy", **velocity._asdict()),
        ]


class _ByPaper:
    """Executes the action of the state of Eq. 9."""

    def __init__(self, model: PaperModel) -> None:
        self._maker = DecisionMaker(model)
        self._states = model.states

    def understands(self, state: State) -> bool:
        return not len(state.keyframes) and (state.state is None or state.state < self._states)

    def reset(self) -> None:
        self._maker.reset()

    def answer(self, state: State, _delay_s: float, _sight: ObstacleSight) -> list[Message]:
        answer: list[Message] = []
        if state.status in {"recognized", "unknown"}:
            decision = self._maker.decide(Recognition(state.status, state.tick, state.state))
            atoms = tuple(atom.name.lower() for atom in decision.atoms)
            answer.append(
                Action.after(state, kind=decision.kind, state=decision.state, atoms=atoms)
            )
        answer.append(
            Command.after(state, source="policy", atom=self._maker.next_atom().name.lower())
        )
        return answer
