"""Execution, second half: from a state to atom movements.

The paper executes the l atoms of the action of the recognised state. Templates are cut at fixed phases, so that
this action is up to l / 2 frames early or late, which is why its success falls as l grows. We know the phase of
the query (`smal.state_space.phase`) and of every demonstrated occurrence of the state; so the decision maker takes
an occurrence of (state, policy action) and continues its demonstration from the frame that the robot is at
("aligned"). `aligned=False` is the scheme of the paper.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from smal.action_space import Atom, first_frame
from smal.model import Model
from smal.recognition import Recognition


@dataclass(frozen=True)
class Decision:
    """What to do next, and why.

    Parameters
    ----------
    kind : str
        "action": the policy's action; "goal": the rest of a demonstration that ended here, then stop;
        "dead_end": the rest of a drive that stopped here without success; "look_around": turn on the spot,
        since the state is unknown; "stop": looking around has not helped; "wait": no state is due yet.
    atoms : tuple of Atom
        The plan, `stride` atoms long; empty for "wait", which leaves the last plan as it is.
    state, action : int or None
    demonstration, frame : int or None
        Where the atoms come from.
    """

    kind: Literal["action", "goal", "dead_end", "look_around", "stop", "wait"]
    atoms: tuple[Atom, ...]
    state: int | None = None
    action: int | None = None
    demonstration: int | None = None
    frame: int | None = None


@dataclass(frozen=True)
class _Occurrence:
    """A demonstrated sequence: the last frame of it, the phase of that frame, and the action that followed."""

    demonstration: int
    last_frame: int
    phase: float
    action: int
    ends: bool


class DecisionMaker:
    """Plans `stride` atoms whenever a state is recognised, and hands them out one by one.

    Parameters
    ----------
    model : Model
    stride : int, optional
        Atoms between two decisions, 1 to l; l is the paper's scheme.
    look_around_ticks : int
        How many atoms it turns left in all while the state stays unknown, before it stops.
    aligned : bool
        Whether to continue from the frame that the robot is at (module docstring).

    Raises
    ------
    ValueError
        A parameter out of range.
    """

    def __init__(
        self, model: Model, stride: int | None = None, look_around_ticks: int = 40, aligned: bool = True
    ) -> None:
        self._model = model
        self._stride = model.sequence_length if stride is None else stride
        if not 1 <= self._stride <= model.sequence_length:
            raise ValueError(f"stride must be 1 to the sequence length {model.sequence_length}, got {stride}")
        if look_around_ticks < 0:
            raise ValueError(f"look_around_ticks must not be negative, got {look_around_ticks}")
        self._look_around_ticks = look_around_ticks
        self._aligned = aligned
        self._goals = frozenset(model.transitions.goals.tolist())
        self._occurrences = _index_occurrences(model)
        self.reset()

    def reset(self) -> None:
        """Drop the plan, for a new episode."""
        self._plan: deque[Atom] = deque()
        self._turns_left = self._look_around_ticks

    def next_atom(self) -> Atom:
        """Take the next atom of the plan; stop when there is none."""
        return self._plan.popleft() if self._plan else Atom.STOP

    def decide(self, recognition: Recognition) -> Decision:
        """Replace the plan according to what was recognised."""
        if recognition.status == "collecting":
            return Decision("wait", ())
        if recognition.status == "unknown" or recognition.state is None or recognition.phase is None:
            decision = self._look_around(None)
        else:
            decision = self._act(recognition.state, recognition.phase)
        if decision.kind in {"action", "goal"}:
            self._turns_left = self._look_around_ticks
        self._plan = deque(decision.atoms)
        return decision

    def _look_around(self, state: int | None) -> Decision:
        """Turn on the spot, a bounded number of atoms in all; the views may become known ones."""
        turns = min(self._stride, self._turns_left)
        self._turns_left -= turns
        atoms = (Atom.LEFT,) * turns + (Atom.STOP,) * (self._stride - turns)
        return Decision("look_around" if turns else "stop", atoms, state)

    def _act(self, state: int, phase: float) -> Decision:
        """Find the demonstrated frame that is closest to where the robot is, and continue from there."""
        action = int(self._model.policy[state])
        if state in self._goals:
            kind: Literal["action", "goal", "dead_end"] = "goal"
            fitting = [one for one in self._occurrences[state] if one.ends]
        else:
            kind = "action" if action >= 0 else "dead_end"
            fitting = [one for one in self._occurrences[state] if action in (one.action, -1)]
        nearest = min(fitting, key=lambda one: abs(one.phase - phase))
        shift = round(phase - nearest.phase) if self._aligned else 0
        frame = max(0, nearest.last_frame + shift)
        recorded = self._model.atoms[nearest.demonstration][frame : frame + self._stride]
        if kind == "dead_end" and not np.any(recorded):
            return self._look_around(state)
        atoms = tuple(Atom(int(atom)) for atom in recorded)
        atoms += (Atom.STOP,) * (self._stride - len(atoms))
        return Decision(kind, atoms, state, action if action >= 0 else None, nearest.demonstration, frame)


def _index_occurrences(model: Model) -> list[list[_Occurrence]]:
    """Every demonstrated sequence, by its state."""
    found: list[list[_Occurrence]] = [[] for _ in range(model.states)]
    length = model.sequence_length
    for number, atoms in enumerate(model.atoms):
        streams: tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.int32]] = (
            model.state_streams[number],
            model.phases[number],
            model.action_streams[number],
        )
        count = len(streams[0])
        for index, (state, phase, action) in enumerate(zip(*(part.tolist() for part in streams), strict=True)):
            last = first_frame(len(atoms), length) + (index + 1) * length - 1
            ends = index == count - 1 and model.successful[number]
            found[state].append(_Occurrence(number, last, phase, action, ends))
    return found
