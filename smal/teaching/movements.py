"""Movement of each atom between two frames, measured on drives."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from smal.arrays import Bools, Floats, Int8s
from smal.movement import Atom, Movement

#: The opposite of each atom, and the factors of its way ahead and its turn.
_MIRRORED: Final = {
    Atom.LEFT: (Atom.RIGHT, (1.0, -1.0)),
    Atom.RIGHT: (Atom.LEFT, (1.0, -1.0)),
    Atom.FORWARD: (Atom.BACKWARD, (-1.0, -1.0)),
    Atom.BACKWARD: (Atom.FORWARD, (-1.0, -1.0)),
}


def atom_movements(poses: Sequence[Floats], atoms: Sequence[Int8s]) -> Floats:
    """Measure the movement of each atom between two frames.

    Parameters
    ----------
    poses : sequence of array (f, 3)
        Odometry of each drive.
    atoms : sequence of array (f,)

    Returns
    -------
    array (5, 2)
        Way ahead, and turn in radians.

    Notes
    -----
    The movement is the median over the frames of a drive, and the largest over the drives: pauses between keys, or a
    slow driver, must not make the robot slow. Only the later half of the longest turns counts: at the start the robot
    still rolls ahead, which does not make it a car. If a robot turns on the spot in one drive, the bends of other
    drives are ignored. A missing turn mirrors the opposite turn, and a missing BACKWARD the opposite of FORWARD. A car
    without straight ways goes ahead as fast as it turns.
    """
    drives = zip(poses, atoms, strict=True)
    movements = np.array([_movements_of(way, executed) for way, executed in drives])
    size = np.hypot(movements[..., 0], movements[..., 1])
    size[:, Atom.STOP] *= -1.0
    turns = [Atom.LEFT, Atom.RIGHT]
    ahead = np.abs(movements[..., 0])
    rolls = ahead[:, turns] >= 0.1 * ahead[:, [Atom.FORWARD]]
    on_spot = ~rolls & (movements[:, turns, 1] != 0.0)
    bends = on_spot.any(axis=0) & ~on_spot
    size[:, turns] -= np.where(bends, np.inf, 0.0)
    return np.asarray(movements[size.argmax(axis=0), np.arange(len(Atom))])


def _movements_of(way: Floats, atoms: Int8s) -> Floats:
    """Measure the movements of the atoms in one drive."""
    executed = atoms[:-1]
    steps = [Movement.between(*pair) for pair in pairwise(way)]
    moved = np.array([(step.ahead, step.turn_rad) for step in steps]).reshape(-1, 2)
    settled = _settled(executed)
    samples = {atom: moved[(executed == atom) & settled] for atom in Atom}
    table = np.zeros((len(Atom), 2))
    for atom, sample in samples.items():
        if len(sample):
            table[atom] = np.median(sample, axis=0)
    if not len(samples[Atom.FORWARD]) and not len(samples[Atom.BACKWARD]):
        bends = moved[(executed == Atom.LEFT) | (executed == Atom.RIGHT)]
        samples[Atom.FORWARD] = bends
        table[Atom.FORWARD, 0] = np.median(bends[:, 0]) if len(bends) else 0.0
    for atom, (opposite, mirror) in _MIRRORED.items():
        if not len(samples[atom]) and len(samples[opposite]):
            table[atom] = table[opposite] * mirror
    return table


def _settled(atoms: Int8s) -> Bools:
    """Return which frames (f,) count: all but the beginnings of turns, up to half of the longest turn."""
    frames = np.arange(atoms.size)
    starts = np.append(True, atoms[1:] != atoms[:-1])
    since = frames - np.maximum.accumulate(np.where(starts, frames, 0))
    settled = np.ones(atoms.size, dtype=np.bool_)
    for atom in (Atom.LEFT, Atom.RIGHT):
        turning = atoms == atom
        longest = since[turning].max(initial=0)
        settled &= ~turning | (2 * since >= longest)
    return settled
