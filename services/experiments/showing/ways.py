"""The taught ways as a graph: how they lie to each other, where they part and meet, and how to draw them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from smal.movement import placed, wrapped
from smal.visual_map import VisualMap


@dataclass(frozen=True)
class Parting:
    """Where ways that are shared part, or meet.

    Parameters
    ----------
    fork : bool
        Whether they part, in the direction of driving.
    keyframe : int
        On one of them, the last or first one that is shared.
    drives : tuple of int
        All that part or meet here.
    """

    fork: bool
    keyframe: int
    drives: tuple[int, ...]


class Ways:
    """The taught ways of a map.

    Attributes
    ----------
    poses : float64 array (f, 3)
        Of every taught frame, in axes that all drives of a group have in common.
    groups : int array (drives,)
        Drives that are joined, directly or by others, have the same number; from 0.
    """

    def __init__(self, taught: VisualMap) -> None:
        self.map = taught
        self.of = taught.drives[taught.keyframes]
        self.poses = taught.poses.copy()
        self.groups = np.full(len(taught.goals), -1)
        self._joints = self._joints_of_pairs()
        self._nearest: dict[int, KDTree] = {}
        for drive in range(len(taught.goals)):
            if self.groups[drive] < 0:
                self.groups[drive] = self.groups.max() + 1
                self._place_all_joined_to(drive)

    def _joints_of_pairs(self) -> dict[tuple[int, int], NDArray[np.intp]]:
        """Return which stitches lead from the one drive to the other, for each pair that has any."""
        pairs = self.of[self.map.stitched]
        return {
            (int(one), int(other)): np.flatnonzero((pairs == (one, other)).all(axis=1))
            for one, other in np.unique(pairs, axis=0)
        }

    def _place_all_joined_to(self, drive: int) -> None:
        group = self.groups[drive]
        placed_now = {drive}
        while True:
            # What is shared for longest tells best how axes lie to each other.
            open_pairs = [
                (stitches.size, one, other)
                for (one, other), stitches in self._joints.items()
                if other in placed_now and self.groups[one] < 0
            ]
            if not open_pairs:
                return
            _, one, other = max(open_pairs)
            self._place(one, other)
            self.groups[one] = group
            placed_now.add(one)

    def _place(self, one: int, other: int) -> None:
        """Move the poses of a drive to where its stitches with another, which has its place, say on average."""
        which = self._joints[one, other]
        here, there = self.map.stitched[which].T
        own = self.map.key_poses[here]
        robot = placed(self.map.stitch_offsets[which], self.poses[self.map.keyframes[there]])
        turns = robot[:, 2] - own[:, 2]
        turn = turns[0] + float(np.mean(wrapped(turns - turns[0])))
        # A rigid movement of its axes: turned, then shifted to where the stitches say on average.
        turned = placed(own, np.array([0.0, 0.0, turn]))
        shift = np.array([*np.mean(robot[:, :2] - turned[:, :2], axis=0), turn])
        frames = self.map.drives == one
        self.poses[frames] = placed(self.map.poses[frames], shift)

    @cached_property
    def key_poses(self) -> NDArray[np.float64]:
        """Poses of the keyframes, in common axes."""
        return self.poses[self.map.keyframes]

    @cached_property
    def way(self) -> NDArray[np.float64]:
        """Way from the start of its drive to each frame, (f,)."""
        starts = np.searchsorted(self.map.drives, self.map.drives)
        way: NDArray[np.float64] = self.map.arc - self.map.arc[starts]
        return way

    @cached_property
    def shared(self) -> NDArray[np.bool_]:
        """Which keyframes show a place that another drive shows too, (k,)."""
        return np.isin(np.arange(len(self.of)), self.map.stitched)

    @cached_property
    def partings(self) -> tuple[Parting, ...]:
        """Where shared ways part or meet; within a correlation length it is one place."""
        found: list[Parting] = []
        for one, other in self._joints:
            for fork, keyframe in self._partings_of(one, other):
                self._add(found, Parting(fork, keyframe, (one, other)))
        return tuple(sorted(found, key=lambda parting: parting.keyframe))

    def _add(self, found: list[Parting], new: Parting) -> None:
        here = self.key_poses[new.keyframe, :2]
        for number, known in enumerate(found):
            same = known.fork == new.fork and set(known.drives) & set(new.drives)
            apart = float(np.hypot(*(self.key_poses[known.keyframe, :2] - here)))
            if same and apart < self.map.correlation_length:
                drives = tuple(sorted({*known.drives, *new.drives}))
                found[number] = Parting(known.fork, min(known.keyframe, new.keyframe), drives)
                return
        found.append(Parting(new.fork, new.keyframe, tuple(sorted(new.drives))))

    def _partings_of(self, one: int, other: int) -> list[tuple[bool, int]]:
        """Return where a drive leaves another (True) or comes to it (False), and the keyframe there.

        Where it is not stitched to the other but stays within a correlation length of it, it has not left it.
        """
        here = np.flatnonzero(self.of == one)
        partner = dict(self.map.stitched[self._joints[one, other]].tolist())
        far = self._apart(here, other) > self.map.correlation_length
        joined = np.array([key in partner for key in here.tolist()])
        # Stretches between joints, each with the last joint before and the first one after it.
        joints = np.flatnonzero(joined)
        found = []
        for last, following in zip(joints, [*joints[1:], len(here)], strict=True):
            if far[last + 1 : following].any() and self._goes_elsewhere(partner[int(here[last])], one, ahead=True):
                found.append((True, int(here[last])))
        for before, first in zip([-1, *joints[:-1]], joints, strict=True):
            if far[before + 1 : first].any() and self._goes_elsewhere(partner[int(here[first])], one, ahead=False):
                found.append((False, int(here[first])))
        return found

    def _goes_elsewhere(self, keyframe: int, other: int, *, ahead: bool) -> bool:
        """Whether the drive of a keyframe, on or back from it, is ever far from another: it does not end here."""
        own = np.flatnonzero(self.of == self.of[keyframe])
        rest = own[own > keyframe] if ahead else own[own < keyframe]
        return bool((self._apart(rest, other) > self.map.correlation_length).any())

    def _apart(self, keyframes: NDArray[np.intp], drive: int) -> NDArray[np.float64]:
        """Return how far keyframes are from the way of a drive."""
        if drive not in self._nearest:
            self._nearest[drive] = KDTree(self.key_poses[self.of == drive, :2])
        return np.asarray(self._nearest[drive].query(self.key_poses[keyframes, :2])[0])


def schematic(streams: Sequence[Sequence[tuple[Hashable, float]]]) -> dict[Hashable, tuple[float, float]]:
    """Place the nodes of ways of which only the order is known: each way to the right, and a row below where it is new.

    Parameters
    ----------
    streams
        Of each way its nodes, with how far each is from the one before.
    """
    places: dict[Hashable, tuple[float, float]] = {}
    row = 0.0
    for stream in streams:
        x, new = 0.0, False
        for node, step in stream:
            if node not in places:
                places[node] = (x + step, row)
                new = True
            x = places[node][0]
        row -= new
    return places
