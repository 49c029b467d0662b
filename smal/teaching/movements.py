"""What each atom does between two frames, measured on drives."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from smal.arrays import Floats, Int8s
from smal.movement import Atom, Movement

#: The opposite of each atom, and how the way ahead and the turn of the two compare.
_MIRRORED: Final = {
    Atom.LEFT: (Atom.RIGHT, (1.0, -1.0)),
    Atom.RIGHT: (Atom.LEFT, (1.0, -1.0)),
    Atom.FORWARD: (Atom.BACKWARD, (-1.0, -1.0)),
    Atom.BACKWARD: (Atom.FORWARD, (-1.0, -1.0)),
}


def atom_movements(poses: Sequence[Floats], atoms: Sequence[Int8s]) -> Floats:
    """Measure what each atom does between two frames, float64 (5, 2): its way ahead, and its turn in radians.

    It is the median over a demonstration's frames, odometry (f, 3) and atoms (f,); of several the one in which it does
    most: who pauses between keys, or is slow, does not make the robot so. Of turns the later half of the longest
    counts: in a short one the robot still rolls ahead, which makes no car of it. A robot that turns on the spot in one
    drive was driven in bends in those where a turn leads ahead. Of an atom that was never made: a turn is
    that to the other side, backward the opposite of forward, and a car that never drove straight on does so as fast as
    it turns.
    """
    each = np.array([_movements_of(*drive) for drive in zip(poses, atoms, strict=True)])
    most = np.hypot(*np.moveaxis(each, -1, 0)) * np.where(
        np.arange(len(Atom)) == Atom.STOP, -1.0, 1.0
    )
    turns = [Atom.LEFT, Atom.RIGHT]
    spot = (np.abs(each[:, turns, 0]) < 0.1 * np.abs(each[:, [Atom.FORWARD], 0])) & (
        each[:, turns, 1] != 0.0
    )
    most[:, turns] -= np.where(spot.any(axis=0) & ~spot, np.inf, 0.0)
    return np.asarray(each[most.argmax(axis=0), np.arange(len(Atom))])


def _movements_of(way: Floats, atoms: Int8s) -> Floats:
    """Measure what each atom did in one drive."""
    made = atoms[:-1]
    steps = [Movement.between(*pair) for pair in pairwise(way)]
    told = np.array([(step.ahead, step.turn_rad) for step in steps]).reshape(-1, 2)
    starts = np.append(True, made[1:] != made[:-1])
    since = np.arange(made.size) - np.maximum.accumulate(np.where(starts, np.arange(made.size), 0))
    longest = {atom: since[made == atom].max(initial=0) for atom in (Atom.LEFT, Atom.RIGHT)}
    found = {atom: told[(made == atom) & (2 * since >= longest.get(atom, 0))] for atom in Atom}
    table = np.array(
        [np.median(each, axis=0) if len(each) else (0.0, 0.0) for each in found.values()]
    )
    if not len(found[Atom.FORWARD]) and not len(found[Atom.BACKWARD]):
        found[Atom.FORWARD] = bends = told[(made == Atom.LEFT) | (made == Atom.RIGHT)]
        table[Atom.FORWARD, 0] = np.median(bends[:, 0]) if len(bends) else 0.0
    for this, (opposite, mirror) in _MIRRORED.items():
        if not len(found[this]) and len(found[opposite]):
            table[this] = table[opposite] * mirror
    return table
