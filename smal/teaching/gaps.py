"""Gaps of a drive without odometry: how far the robot went while no frame was recorded.

A camera drops a frame, a recording pauses while the robot stands, or a person deletes frames. The
views on both sides of a gap show how far the robot went: for as many steps of the action before the
gap as it usually takes until views differ as much. If no two frames without a gap between them
differ as much, the action is taken to last for all of the lost time.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
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
#: More steps than any gap.
_ANY: Final = 10**9


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
    before = np.array(sorted(gaps), dtype=np.intp)
    for atom in np.unique(atoms[before]):
        some = before[atoms[before] == atom]
        alike = _Likeness(centred, before, np.flatnonzero(atoms == atom), atoms.size)
        lost = np.array([gaps[frame] for frame in some.tolist()])
        repeats[some] = np.minimum(alike.steps(some), lost + 1)
    executed = np.append(np.repeat(atoms, repeats), atoms[-1])
    poses = dead_reckoning(executed, movements)
    starts = np.cumsum(repeats) - repeats
    return np.asarray(poses[starts])


@dataclass(frozen=True)
class _Likeness:
    """Likeness of the views of a drive some frames after a frame with one action."""

    centred: Callable[[Iterable[int]], Float32s]
    #: Frames before gaps.
    before: Indices
    #: Frames with the action, of `count` frames.
    frames: Indices
    count: int

    def steps(self, before: Indices) -> Indices:
        """Return the number of usual steps between the frames before and after some gaps."""
        apart, mean = self._falling()
        cosines = _cosines(self.centred, before, before + 1)
        # The curve ends where views are unrelated, or where a gap ends each part of the drive.
        most = apart[-1] if mean[-1] <= self._unrelated else _ANY
        steps = np.interp(-cosines, -np.array(mean), apart, right=most)
        return np.asarray(np.rint(steps), dtype=np.intp)

    def _falling(self) -> tuple[list[int], list[float]]:
        """Return distances in frames, and the mean cosine of views at each, up to unrelated views."""
        apart = [0]
        mean = [1.0]
        for many in _APART.tolist():
            gaps = np.searchsorted(self.before, self.frames + many)
            first = self.frames[gaps == np.searchsorted(self.before, self.frames)]
            first = first[first + many < self.count]
            if first.size and mean[-1] > self._unrelated:
                some = first[evenly(first.size, _COMPARED)]
                cosine = float(_cosines(self.centred, some, some + many).mean())
                apart.append(many)
                mean.append(min(mean[-1], cosine))
        return apart, mean

    @cached_property
    def _unrelated(self) -> float:
        """Cosine from which views are unrelated."""
        rows = self.centred(evenly(self.count, _COMPARED).tolist())
        return 1.0 - _UNRELATED * (1.0 - float((rows @ rows.T).mean()))


def _cosines(
    centred: Callable[[Iterable[int]], Float32s], first: Indices, second: Indices
) -> AnyArray:
    """Return the cosines of the views of pairs of frames, (n,)."""
    frames, numbers = np.unique(np.concatenate([first, second]), return_inverse=True)
    rows = centred(frames.tolist())[numbers]
    cosines: AnyArray = (rows[: first.size] * rows[first.size :]).sum(axis=1)
    return cosines
