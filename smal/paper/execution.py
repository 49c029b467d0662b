"""The paper's execution, second half: from a state to the l atom movements of the policy's action."""

from collections import deque
from dataclasses import dataclass
from typing import Literal

from smal.movement import Atom
from smal.paper.model import Model
from smal.paper.recognition import Recognition


@dataclass(frozen=True)
class Decision:
    """What to do next, and why.

    Parameters
    ----------
    kind : str
        "action": the policy's action; "goal": stop, since a demonstration ended here with success; "dead_end": stop,
        since nothing is known to follow; "stop": stop, since the state is unknown; "wait": no state is due yet.
    atoms : tuple of Atom
        The plan, l atoms long; empty for "wait", which leaves the last plan as it is.
    state, action : int or None
    """

    kind: Literal["action", "goal", "dead_end", "stop", "wait"]
    atoms: tuple[Atom, ...]
    state: int | None = None
    action: int | None = None


class DecisionMaker:
    """Plans l atoms whenever a state is recognized, and hands them out one by one."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._goals = frozenset(model.transitions.goals.tolist())
        self.reset()

    def reset(self) -> None:
        """Drop the plan, for a new episode."""
        self._plan: deque[Atom] = deque()

    def next_atom(self) -> Atom:
        """Take the next atom of the plan; stop when there is none."""
        return self._plan.popleft() if self._plan else Atom.STOP

    def decide(self, recognition: Recognition) -> Decision:
        """Replace the plan according to what was recognized."""
        if recognition.status == "collecting":
            return Decision("wait", ())
        decision = self._decide(recognition.state)
        self._plan = deque(decision.atoms)
        return decision

    def _decide(self, state: int | None) -> Decision:
        stop = (Atom.STOP,) * self._model.sequence_length
        if state is None:
            return Decision("stop", stop)
        action = int(self._model.policy[state])
        if action < 0:
            return Decision("goal" if state in self._goals else "dead_end", stop, state)
        return Decision("action", tuple(map(Atom, self._model.actions[action].tolist())), state, action)
