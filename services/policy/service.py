"""Policy service: answers every state with a command, and with a decision if one is due."""

import logging
import math
from collections import deque
from statistics import median
from typing import Final, NamedTuple

from schemas.action import Action
from schemas.base import Message, Velocity
from schemas.command import Command, CommandApplied
from schemas.rpc import LoadReply
from schemas.state import State
from services.kit.belief import belief_of, target_of
from services.kit.model_service import LoadedModel, Wheels
from services.kit.node import Detail
from services.kit.obstacle_memory import ObstacleMemory
from services.kit.throttle import Throttle
from smal.model import Model
from smal.paper.execution import DecisionMaker, Recognition
from smal.paper.model import PaperModel
from smal.planning import Planner

# Number of delay reports for the median: one second.
DELAYS_KEPT: Final = 10
SHOWN: Final = 100  # Maximum obstacles in a decision, for display.
_log = logging.getLogger("policy")


class PolicyService:
    """Answers every frame with a command; stops and drops its plan if recognition has another model.

    A loaded model is prepared here first, and used from recognition's first state with it. Until
    then the previous model stays in use, so that the robot need not stop for the change.
    """

    def __init__(self) -> None:
        self._loaded: LoadedModel | None = None
        self._maker: _ByFilter | _ByPaper | None = None
        # Model that recognition can still use.
        self._before: tuple[LoadedModel, _ByFilter | _ByPaper] | None = None
        self._last: tuple[State, list[Message]] | None = None
        self._foreign = 0
        self._complaints = Throttle()
        self.obstacles = ObstacleMemory()  # Obstacles around the robot, which the plan avoids.
        #: Recent delays of its commands until the robot moves, as reported by the actuator.
        self._delays_s: deque[float] = deque([0.0], maxlen=DELAYS_KEPT)
        #: Whether the actuator has stopped its last motion before an obstacle.
        self._held_back = False

    def load(self, loaded: LoadedModel) -> LoadReply:
        """Work with another model as soon as recognition does."""
        model = loaded.model
        if self._before is None and self._loaded is not None and self._maker is not None:
            self._before = self._loaded, self._maker
        if self._before is not None and self._before[0].identity == loaded.identity:
            self._before = None  # A new goal in the same model applies at once.
        maker = _ByFilter(model, loaded.goal) if isinstance(model, Model) else _ByPaper(model)
        self._loaded = loaded
        self._maker = maker
        self._last = None
        self._foreign = 0
        return loaded.reply()

    @property
    def loaded(self) -> LoadedModel | None:
        """The model in use."""
        return self._loaded

    def hands_on(self) -> None:
        """Return None: the plan follows from the next state."""

    def resume(self, state: State, wheels: Wheels | None) -> None:
        """Do nothing: the plan follows from the next state."""

    def see_applied(self, applied: CommandApplied) -> None:
        """Store what the actuator reports about a command: its delay, and whether an obstacle stops the robot."""
        if applied.source == "policy" and applied.delay_ns is not None:
            self._delays_s.append(applied.delay_ns / 1e9)
        stops = applied.reason == "obstacle" and applied.linear == 0.0
        self._held_back = applied.source == "policy" and stops

    def handle(self, state: State) -> list[Message]:
        """Return the decision, if one is due at this frame, and the command."""
        if self._loaded is None or self._maker is None or state.status == "idle":
            return []
        loaded = self._loaded
        maker = self._maker
        if self._before is not None and state.model == self._before[0].identity:
            loaded, maker = self._before
        elif state.model == loaded.identity:
            self._before = None
        if state.model != loaded.identity or not maker.understands(state):
            return [self._refuse(state, loaded, maker)]
        if self._last is not None:
            last, answer = self._last
            if (last.episode, last.tick) == (state.episode, state.tick):
                # The simulator asked again after a lost answer: repeat the answer, with the plan
                # unchanged.
                return answer
            if last.episode != state.episode:
                maker.reset()
        reported = _Reported(median(self._delays_s), self._held_back)
        answer = maker.answer(state, reported, self.obstacles)
        self._last = (state, answer)
        return answer

    def _refuse(self, state: State, loaded: LoadedModel, maker: "_ByFilter | _ByPaper") -> Command:
        """Stop, and drop the plan for when the states belong to this model again."""
        maker.reset()
        self._last = None
        self._foreign += 1
        if self._complaints.due():
            why = (
                f"recognition has model {state.model}, policy has {loaded.identity}; "
                "load the same into both"
            )
            if state.model == loaded.identity:
                why = (
                    f"invalid state: no such place in its model {state.model}; "
                    "check the publishers of states"
                )
            _log.warning("stopping: %s (%s, %d states in total)", why, loaded.name, self._foreign)
        return Command.after(state, source="policy", atom="stop")

    def detail(self) -> Detail:
        """Return the loaded model, and the number of states of other models since it was loaded."""
        # This runs on a thread of the bus: the model can change at any time.
        loaded = self._loaded
        return (
            {"model": None}
            if loaded is None
            else loaded.detail() | {"states_of_another_model": self._foreign}
        )


class _Reported(NamedTuple):
    """Reports of the actuator about recent commands."""

    delay_s: float
    held_back: bool


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

    def answer(self, state: State, reported: _Reported, obstacles: ObstacleMemory) -> list[Message]:
        elapsed_s = state.since(self._stamp_ns)
        self._stamp_ns = state.stamp_ns
        around = obstacles.around(state.episode, self._planner.radius_m)
        unexpected_ground = math.inf if state.strange_m is None else state.strange_m
        decision = self._planner.decide(
            belief_of(state),
            elapsed_s,
            reported.delay_s,
            target_of(state),
            around,
            unexpected_ground,
            held_back=reported.held_back,
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

    def answer(
        self, state: State, _reported: _Reported, _obstacles: ObstacleMemory
    ) -> list[Message]:
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
