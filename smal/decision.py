"""Execution, second half: from a state to atom movements.

The paper executes the l atoms of the action of the recognised state. Two things make that fail as l grows or as
demonstrations of one route pile up, and both have their remedy in W.

* Templates are cut at fixed phases, so that the action is up to l / 2 frames early or late. We know the phase of the
  query (`smal.alignment.phase`) and of every demonstrated occurrence of a state; so we take an occurrence of (state,
  policy action) and continue its demonstration from the frame that the robot is at ("aligned").
* Several states share the weight where they resemble each other, and the heaviest alone (Eq. 9) may be a poor one.
  The weights are a belief over states; as in QMDP (Littman, Cassandra and Kaelbling 1995) each state proposes what
  its policy would do, and has a say in each atom of the plan ("belief", `smal.plan_votes`).

A third thing is mended with a belief. Where the robot has drifted away from what was taught, the nearest demonstrated
frame stays the same while it moves on; every plan starts there anew, and the turn that the demonstration makes ten
frames later never comes. So plans of before keep a say in every atom, as chunks of actions do in temporal ensembling
(Zhao et al., ACT, 2023): the more, the less of the last frames is explained and the less the demonstration goes by. A
robot that knows where it is, or moves along, follows its latest plan alone.

The scheme of the paper is `aligned=False, belief=False` with a stride of l, after `Recognizer(model, shorten=False)`.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Any, Literal

from numpy.typing import NDArray

from smal.action_space import Atom
from smal.model import Model
from smal.plan_votes import PlanVotes, Progress
from smal.recognition import HIDDEN_TICKS, Candidate, Recognition
from smal.sequences import last_frames

#: Frames for which the robot may continue its last plan while the state is unknown: at 0.1 s each about as long as
#: something in passing hides the view. A robot that turned at once would have to find its heading again each time.
COAST_TICKS = HIDDEN_TICKS
#: Share of a view that may stay unexplained for a robot to stop looking around.
SETTLED_RESIDUAL = 0.7


@dataclass(frozen=True)
class Decision:
    """What to do next, and why.

    Parameters
    ----------
    kind : str
        "action": the policy's action; "goal": the rest of a demonstration that ended here, then stop;
        "dead_end": the rest of a drive that stopped here without success; "coast": the rest of the last plan, or its
        last movement again, for a moment in which the state is unknown; "look_around": turn on the spot, since the
        state is unknown; "stop": looking around has not helped; "wait": no state is due yet.
    atoms : tuple of Atom
        The plan, l atoms long; what is left of it for "coast"; empty for "wait". Both leave the last plan as it is.
    state, action : int or None
    demonstration, frame : int or None
        Where the atoms come from; with a belief, those of the heaviest state.
    """

    kind: Literal["action", "goal", "dead_end", "coast", "look_around", "stop", "wait"]
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
    """Plans l atoms whenever a state is recognised, and hands them out one by one until the next plan replaces them.

    With a stride shorter than l the rest of a plan is for decisions that come late, or not at all.

    Parameters
    ----------
    model : Model
    stride : int
        Atoms between two decisions, 1 to l.
    look_around_ticks : int
        How many atoms it turns left while states are unknown, before it stops; moving on restores them.
    aligned : bool
        Whether to continue from the frame that the robot is at (module docstring).
    belief : bool
        Whether all candidate states have a say, by their weight, and plans of before (module docstring).
    coast : bool
        Whether the robot goes on for a moment while the state is unknown, before it looks around.

    Raises
    ------
    ValueError
        A parameter out of range.
    """

    def __init__(
        self,
        model: Model,
        stride: int = 1,
        look_around_ticks: int = 80,
        aligned: bool = True,
        belief: bool = True,
        coast: bool = True,
    ) -> None:
        self._model = model
        self._horizon = model.sequence_length
        self._stride = stride
        if not 1 <= self._stride <= model.sequence_length:
            raise ValueError(f"stride must be 1 to the sequence length {model.sequence_length}, got {stride}")
        if look_around_ticks < 0:
            raise ValueError(f"look_around_ticks must not be negative, got {look_around_ticks}")
        self._look_around_ticks = look_around_ticks
        self._aligned = aligned
        self._belief = belief
        self._coast = coast
        self._goals = frozenset(model.transitions.goals.tolist())
        self._occurrences = _index_occurrences(model)
        self._votes = PlanVotes(self._horizon)
        self._progress = Progress(stride)
        self.reset()

    def reset(self) -> None:
        """Drop the plan, for a new episode."""
        self._plan: deque[Atom] = deque()
        self._votes.clear()
        self._progress.reset()
        self._turns_left = self._look_around_ticks
        self._looking = False
        self._coasted = 0
        self._last = Atom.STOP

    def next_atom(self) -> Atom:
        """Take the next atom of the plan; stop when there is none."""
        atom = self._last = self._plan.popleft() if self._plan else Atom.STOP
        self._votes.made(atom)
        if self._looking and atom != Atom.STOP:
            self._turns_left -= 1
        return atom

    def decide(self, recognition: Recognition) -> Decision:
        """Replace the plan according to what was recognised."""
        if recognition.status == "collecting":
            return Decision("wait", ())
        if recognition.state is None or recognition.phase is None or self._keeps_looking(recognition):
            if self._may_coast():
                self._coasted += self._stride
                while len(self._plan) < self._stride:
                    self._plan.append(self._plan[-1] if self._plan else self._last)
                return Decision("coast", tuple(self._plan))
            decision = self._look_around(recognition.state)
        else:
            if self._belief and recognition.candidates:
                decision = self._act(recognition.candidates, 1.0 - recognition.explained)
            else:
                decision = self._act((Candidate(recognition.state, recognition.phase, 1.0),), 0.0)
            self._coasted = 0
        self._looking = decision.kind == "look_around"
        # Not every decision restores the turns: a state that only turns back would make it swing for ever. Nor does
        # what is planned for after the next decision, which may be another one.
        if Atom.FORWARD in decision.atoms[: self._stride] or decision.kind == "goal":
            self._turns_left = self._look_around_ticks
        self._plan = deque(decision.atoms)
        return decision

    def _may_coast(self) -> bool:
        """Whether the robot moves by the plan of a known state, and may go on although the state is unknown."""
        moves = any(self._plan) if self._plan else self._last != Atom.STOP
        return self._coast and moves and not self._looking and self._coasted + self._stride <= COAST_TICKS

    def _keeps_looking(self, recognition: Recognition) -> bool:
        """Whether a robot that is looking around goes on although this view is just about known.

        Such a view often says to turn back to where the robot could not tell where it is; further round there may be
        one that is really known. After a whole turn any will do.
        """
        return self._looking and self._turns_left > 0 and recognition.residual > SETTLED_RESIDUAL

    def _look_around(self, state: int | None) -> Decision:
        """Turn on the spot, a bounded number of atoms in all; the views may become known ones."""
        self._votes.clear()
        turns = min(self._horizon, self._turns_left)
        atoms = (Atom.LEFT,) * turns + (Atom.STOP,) * (self._horizon - turns)
        return Decision("look_around" if turns else "stop", atoms, state)

    def _act(self, candidates: tuple[Candidate, ...], doubt: float) -> Decision:
        """Let the states that know how to go on vote for every atom; the heaviest decides where they tie.

        The doubt is how little of the last frames is explained, 0 to 1 (`Recognition.explained`).
        """
        proposals = [(self._continue(one.state, one.phase), one.weight) for one in candidates]
        voters = [(plan, weight) for plan, weight in proposals if plan.kind != "dead_end"] or proposals[:1]
        leader = voters[0][0]
        if leader.kind == "dead_end" and not any(leader.atoms):
            return self._look_around(leader.state)
        if leader.demonstration is not None and leader.frame is not None:
            self._progress.follow(leader.demonstration, leader.frame)
        persistence = doubt * (1.0 - self._progress.value)
        return replace(leader, atoms=self._votes.cast([(plan.atoms, weight) for plan, weight in voters], persistence))

    def _continue(self, state: int, phase: float) -> Decision:
        """Find the demonstrated frame that is closest to where the robot is, and continue from there."""
        action = int(self._model.policy[state])
        kind: Literal["action", "goal", "dead_end"]
        if state in self._goals:
            kind, fitting = "goal", [one for one in self._occurrences[state] if one.ends]
        else:
            kind = "action" if action >= 0 else "dead_end"
            fitting = [one for one in self._occurrences[state] if action in (one.action, -1)]
        nearest = min(fitting, key=lambda one: abs(one.phase - phase))
        shift = round(phase - nearest.phase) if self._aligned else 0
        frame = max(0, nearest.last_frame + shift)
        recorded = self._model.atoms[nearest.demonstration][frame : frame + self._horizon]
        atoms = tuple(Atom(int(atom)) for atom in recorded)
        atoms += (Atom.STOP,) * (self._horizon - len(atoms))
        return Decision(kind, atoms, state, action if action >= 0 else None, nearest.demonstration, frame)


def _index_occurrences(model: Model) -> list[list[_Occurrence]]:
    """Every demonstrated sequence, by its state."""
    found: list[list[_Occurrence]] = [[] for _ in range(model.states)]
    for number, atoms in enumerate(model.atoms):
        streams: tuple[NDArray[Any], ...] = (
            last_frames(len(atoms), model.sequence_length),
            model.state_streams[number],
            model.phases[number],
            model.action_streams[number],
        )
        for last, state, phase, action in zip(*(part.tolist() for part in streams), strict=True):
            ends = last == len(atoms) - 1 and model.successful[number]
            found[state].append(_Occurrence(number, last, phase, action, ends))
    return found
