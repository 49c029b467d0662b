"""Gaps of a drive without odometry: how far the robot went while no frame was recorded.

A camera drops a frame, a recording pauses while the robot stands, or a person deletes frames. The
views on both sides of a gap show how far the robot went: as far as it usually goes until views
differ as much. The direction is that of the action before the gap.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Indices, Int8s, evenly
from smal.movement import dead_reckoning

#: Frames of a drive that are compared with later frames.
_COMPARED: Final = 60
#: Numbers of frames between compared views.
_APART: Final = np.unique(np.geomspace(1.0, 600.0, 30).astype(np.intp))
#: Share of the fall of the cosines at which views are unrelated, so that the way is unknown.
_UNRELATED: Final = 0.9


def reckoned(
    atoms: Int8s,
    movements: Floats,
    gaps: Mapping[int, int],
    centred: Callable[[Iterable[int]], Float32s],
) -> Floats:
    """Integrate the usual movements of atoms (f,) into poses (f, 3), across the gaps of a drive.

    Parameters
    ----------
    atoms : array (f,)
    movements : array (5, 2)
        Movement of each atom between two frames.
    gaps : mapping
        Ticks that were lost after a frame.
    centred : callable
        Returns the centred features (n, m), of unit length, of n frames.
    """
    repeats = np.ones(atoms.size, dtype=np.intp)
    if gaps:
        before = np.array(sorted(gaps))
        lost = np.array([gaps[frame] for frame in before.tolist()])
        repeats[before] = np.minimum(_steps(before, atoms.size, centred), lost + 1)
    executed = np.append(np.repeat(atoms, repeats), atoms[-1])
    poses = dead_reckoning(executed, movements)
    starts = np.cumsum(repeats) - repeats
    return np.asarray(poses[starts])


def _steps(before: Indices, count: int, centred: Callable[[Iterable[int]], Float32s]) -> Indices:
    """Return the number of usual steps between the frames before and after each gap."""
    cosines = _cosines(centred, before, before + 1)
    mean = [1.0]
    apart = [0]
    for many in _APART[count > _APART].tolist():
        first = evenly(count - many, _COMPARED)
        across = np.searchsorted(before, first) != np.searchsorted(before, first + many)
        if not across.all():
            first = first[~across]
            mean.append(float(_cosines(centred, first, first + many).mean()))
            apart.append(many)
    falling = np.minimum.accumulate(mean)
    related = falling >= 1.0 - _UNRELATED * (1.0 - falling[-1])
    steps = np.interp(-cosines, -falling[related], np.array(apart)[related])
    return np.asarray(np.rint(steps), dtype=np.intp)


def _cosines(
    centred: Callable[[Iterable[int]], Float32s], first: Indices, second: Indices
) -> AnyArray:
    """Return the cosines of the views of pairs of frames, (n,)."""
    frames, numbers = np.unique(np.concatenate([first, second]), return_inverse=True)
    rows = centred(frames.tolist())[numbers]
    cosines: AnyArray = (rows[: first.size] * rows[first.size :]).sum(axis=1)
    return cosines
