"""The paper's states of a model: which drives share them, and what follows each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

from services.recordings.taught import episode_of
from smal.movement import Atom
from smal.paper.model import Model

_ARROWS = {Atom.STOP: "■", Atom.FORWARD: "↑", Atom.BACKWARD: "↓", Atom.LEFT: "↰", Atom.RIGHT: "↱"}


@dataclass(frozen=True)
class StateGraph:
    """What the drives say of the states.

    Parameters
    ----------
    episodes : mapping of int to tuple of str
        In which episodes each state was seen.
    following : mapping of int to tuple of int
        Which other states came after each, ascending.
    """

    episodes: Mapping[int, tuple[str, ...]]
    following: Mapping[int, tuple[int, ...]]

    @property
    def shared(self) -> list[int]:
        """States of at least two episodes."""
        return [state for state, episodes in self.episodes.items() if len(episodes) > 1]

    @property
    def forks(self) -> list[int]:
        """States that more than one other came after."""
        return [state for state, following in self.following.items() if len(following) > 1]


def state_graph(model: Model) -> StateGraph:
    """Read the graph of states off the drives."""
    episodes: dict[int, dict[str, None]] = {state: {} for state in range(model.states)}
    following: dict[int, set[int]] = {state: set() for state in range(model.states)}
    for name, stream in zip(model.names, model.state_streams, strict=True):
        states = stream.tolist()
        for state in states:
            episodes[state][episode_of(name)] = None
        for state, then in pairwise(states):
            if then != state:
                following[state].add(then)
    return StateGraph(
        {state: tuple(names) for state, names in episodes.items()},
        {state: tuple(sorted(states)) for state, states in following.items()},
    )


def action_of(model: Model, state: int) -> str:
    """Return what the policy does in a state, an arrow for each atom; nothing in goals and dead ends."""
    action = int(model.policy[state])
    return "".join(_ARROWS[Atom(atom)] for atom in model.actions[action].tolist()) if action >= 0 else ""
