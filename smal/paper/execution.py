"""The paper's execution, second half: from a state to the l atoms of the policy's action."""

from collections import deque
from dataclasses import dataclass
from typing import Literal

from smal.movement import Atom
from smal.paper.model import PaperModel

Status = Literal["collecting", "recognized", "unknown"]


@dataclass(frozen=True)
class Recognition:
    """State of the last l frames, the last of which is `tick`; the numbers are those of the `Match`.

    The status is "collecting" while the episode has fewer than l frames, or no decision is due. It is "unknown" if W is
    zero. The state is the state of Eq. 9, with the largest weight.
    """

    status: Status
    tick: int
    state: int | None = None
    score: float = 0.0
    total_weight: float = 0.0
    residual: float = 1.0
    agreement: float = 0.0
    duality_gap: float = 0.0


@dataclass(frozen=True)
class PaperDecision:
    """Next atoms, and their reason.

    "action": the policy's action. "goal": stop, because a demonstration ended here with success. "dead_end": stop,
    because no successor is known. "stop": stop, because the state is unknown. "wait": no state is due yet; the plan is
    empty, and the last plan stays. The other plans are l atoms long.
    """

    kind: Literal["action", "goal", "dead_end", "stop", "wait"]
    atoms: tuple[Atom, ...]
    state: int | None = None
    action: int | None = None


class DecisionMaker:
    """Plans l atoms for each recognized state, and returns them one by one."""

    def __init__(self, model: PaperModel) -> None:
        self._model = model
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._plan: deque[Atom] = deque()

    def next_atom(self) -> Atom:
        """Return the next atom of the plan; STOP without any."""
        return self._plan.popleft() if self._plan else Atom.STOP

    def decide(self, recognition: Recognition) -> PaperDecision:
        """Replace the plan by the plan for a recognition."""
        if recognition.status == "collecting":
            return PaperDecision("wait", ())
        model = self._model
        state = recognition.state
        stop = (Atom.STOP,) * self._model.sequence_length
        if state is None:
            decision = PaperDecision("stop", stop)
        elif (action := int(model.policy[state])) >= 0:
            atoms = tuple(map(Atom, model.actions[action].tolist()))
            decision = PaperDecision("action", atoms, state, action)
        elif state in model.transitions.goals:
            decision = PaperDecision("goal", stop, state)
        else:
            decision = PaperDecision("dead_end", stop, state)
        self._plan = deque(decision.atoms)
        return decision
