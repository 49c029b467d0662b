"""Action space (paper, Algorithm 3): an action is l atom movements, taken from the demonstrations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from smal.arrays import Int8s, Int32s
from smal.movement import Atom
from smal.paper.sequences import last_frames


class ActionSpace(NamedTuple):
    """The distinct actions (a, l), and the paper's a-streams: the action after each sequence of a demonstration."""

    actions: Int8s
    streams: tuple[Int32s, ...]


def following_atoms(atoms: Int8s, sequence_length: int) -> Int8s:
    """Return the l atoms after each sequence from atoms (f,), of which atom k follows frame k: int8 (f // l, l).

    For a sequence of the frames t to t + l - 1 these are the atoms t + l - 1 to t + 2 l - 2, executed *after* it.
    (The atoms during the sequence, as in a literal reading of Algorithm 3, replay the past.) The last sequence
    has one recorded atom left, and is padded with stops.
    """
    l = sequence_length  # noqa: E741
    padded = np.concatenate([atoms, np.full(l - 1, Atom.STOP, dtype=np.int8)])
    first = last_frames(atoms.size, l)[:, None]
    following: Int8s = padded[first + np.arange(l)]
    return following


def learn_action_space(demonstrations: Sequence[Int8s], sequence_length: int) -> ActionSpace:
    """Collect the distinct actions of demonstrations, int8 (f,) each; ValueError for no atom or no whole sequence."""
    for atoms in demonstrations:
        if atoms.size and not (atoms.min() >= min(Atom) and atoms.max() <= max(Atom)):
            raise ValueError(
                f"atoms must be {int(min(Atom))} to {int(max(Atom))}, got {sorted(set(atoms.tolist()))}"
            )
    actions_of = [following_atoms(atoms, sequence_length) for atoms in demonstrations]
    if not sum(map(len, actions_of)):
        raise ValueError(f"no demonstration has {sequence_length} frames")
    actions, numbers = np.unique(np.concatenate(actions_of), axis=0, return_inverse=True)
    ends = np.cumsum([len(part) for part in actions_of])[:-1]
    streams = np.split(numbers.ravel().astype(np.int32), ends)
    return ActionSpace(actions, tuple(streams))
