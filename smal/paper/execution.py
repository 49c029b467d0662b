"""The paper's execution, second half: from a state to the l atom movements of the policy's action."""

from collections import deque
from dataclasses import dataclass
from typing import Literal

from smal.movement import Atom
from smal.paper.model import PaperModel


@dataclass(frozen=True)
class Recognition:
    """Which state the last l frames show, the last of which is `tick`; the numbers are those of the `Match`.

    "collecting": the episode has no l frames yet, or no answer was due; "unknown": W is zero. The state is the one of
    Eq. 9, with the largest weight.
    """

    status: Literal["collecting", "recognized", "unknown"]
    tick: int
    state: int | None = None
    score: float = 0.0
    total_weight: float = 0.0
    residual: float = 1.0
    agreement: float = 0.0
    duality_gap: float = 0.0


@dataclass(frozen=True)
class PaperDecision:
    """What to do next, and why.

    "action": the policy's action; "goal": stop, since a demonstration ended here with success; "dead_end": stop, since
    nothing is known to follow; "stop": stop, since the state is unknown; "wait": no state is due yet. The plan is l
    atoms long; "wait" has none, and leaves the last one as it is.
    """

    kind: Literal["action", "goal", "dead_end", "stop", "wait"]
    atoms: tuple[Atom, ...]
    state: int | None = None
    action: int | None = None


class DecisionMaker:
    """Plans l atoms whenever a state is recognized, and hands them out one by one."""

    def __init__(self, model: PaperModel) -> None:
        self._model = model
        self.reset()

    def reset(self) -> None:
        """Drop the plan, for a new episode."""
        self._plan: deque[Atom] = deque()

    def next_atom(self) -> Atom:
        """Take the next atom of the plan; stop when there is none."""
        return self._plan.popleft() if self._plan else Atom.STOP

    def decide(self, recognition: Recognition) -> PaperDecision:
        """Replace the plan according to what was recognized."""
        if recognition.status == "collecting":
            return PaperDecision("wait", ())
        model = self._model
        state = recognition.state
        stop = (Atom.STOP,) * self._model.sequence_length
        if state is None:
            decision = PaperDecision("stop", stop)
        elif (action := int(model.policy[state])) >= 0:
            decision = PaperDecision(
                "action", tuple(map(Atom, model.actions[action].tolist())), state, action
            )
        else:
            decision = PaperDecision(
                "goal" if state in model.transitions.goals else "dead_end", stop, state
            )
        self._plan = deque(decision.atoms)
        return decision
