"""Taught ways of a map: arrangement, junctions, and the belief of the filter on them."""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from smal.map import VisualMap, in_common_axes
from smal.model import Model
from smal.movement import placed, seen_from
from smal.robot import Localizer
from smal.teaching.demonstration import Demonstration


@dataclass(frozen=True)
class Parting:
    """A junction of shared ways (fork or merge): its keyframe and the drives."""

    fork: bool
    keyframe: int
    drives: tuple[int, ...]


class Ways:
    """Taught ways of a map: poses of keyframes (k, 3) and frames (f, 3), with common axes in a group."""

    def __init__(self, taught: VisualMap) -> None:
        self.map = taught
        self.of = taught.key_drives  # (k,) drive of each keyframe.
        self.key_poses = in_common_axes(taught)
        first = np.searchsorted(self.of, taught.drives)
        self.poses = placed(seen_from(taught.poses, taught.key_poses[first]), self.key_poses[first])
        one, other = self.of[taught.stitched].T
        drives = taught.drive_count
        _, self.groups = connected_components(
            coo_array((np.ones(one.size), (one, other)), (drives, drives)), False
        )
        #: (k,) whether another drive shares the place; and its distance from the start of its
        #: drive.
        self.shared = np.isin(np.arange(len(self.of)), taught.stitched)
        arc = taught.arc[taught.keyframes]
        self.way: NDArray[np.float64] = arc - arc[np.searchsorted(self.of, self.of)]

    def at(self, poses: NDArray[np.float64]) -> "Ways":
        """Return the ways with their keyframes at poses (k, 3) of one frame of reference."""
        moved = copy(self)
        moved.key_poses = poses
        moved.groups = np.zeros_like(self.groups)
        return moved

    @property
    def unit(self) -> str:
        """Unit of lengths."""
        return "m" if self.map.odometry else "actions forward"

    @cached_property
    def partings(self) -> tuple[Parting, ...]:
        """Junctions of shared ways; junctions within a correlation length are merged."""
        found: list[Parting] = []
        for one, other in np.unique(self.of[self.map.stitched], axis=0).tolist():
            for fork, keyframe in self._partings_of(one, other):
                same = [
                    each
                    for each in found
                    if each.fork == fork and self._is_near(each.keyframe, keyframe)
                ]
                found = [each for each in found if each not in same]
                drives = {one, other}.union(*(each.drives for each in same))
                first = min([keyframe, *(each.keyframe for each in same)])
                found.append(Parting(fork, first, (*sorted(drives),)))
        return tuple(sorted(found, key=lambda parting: parting.keyframe))

    def _is_near(self, one: int, other: int) -> bool:
        apart = float(np.hypot(*(self.key_poses[one, :2] - self.key_poses[other, :2])))
        joined = self.groups[self.of[one]] == self.groups[self.of[other]]
        return bool(joined) and apart < self.map.correlation_length

    def _partings_of(self, one: int, other: int) -> Iterator[tuple[bool, int]]:
        """Yield the keyframes at which a drive leaves another (True) or joins it (False).

        A shared stretch continues over gaps of two correlation lengths. It has no junction where
        one of the drives starts or ends.
        """
        length = self.map.correlation_length
        last = {drive: self.way[self.of == drive].max() for drive in (one, other)}
        here, there = self.map.stitched[(self.of[self.map.stitched] == (one, other)).all(axis=1)].T
        gaps = np.flatnonzero(np.diff(self.way[here]) > 2.0 * length)
        for begin, end in zip([0, *(gaps + 1)], [*gaps, len(here) - 1], strict=True):
            if min(last[one] - self.way[here[end]], last[other] - self.way[there[end]]) > length:
                yield True, int(here[end])
            if min(self.way[here[begin]], self.way[there[begin]]) > length:
                yield False, int(here[begin])


@dataclass(frozen=True, eq=False)
class Believed:
    """Belief at each frame of a drive, arrays (f,); the rest of the probability is elsewhere."""

    here: NDArray[np.float64]  # Probability of a place within a correlation length of the robot.
    lost: NDArray[np.float64]  # Probability of being off the taught ways.
    # Standard deviation of the place on this drive and connected drives.
    spread: NDArray[np.float64]


def believed(
    model: Model, ways: Ways, drive: int, one: Demonstration, advance: Callable[[], object]
) -> Believed:
    """Run the recognition along a taught drive from its start; advance is called after each frame."""
    localizer = Localizer(model)
    found = []
    first = int(np.searchsorted(ways.map.drives, drive))
    for k, features in enumerate(one.features):
        pose = None if one.odometry is None else one.odometry[k].tolist()
        belief = localizer.observe(features, pose, [one.atoms[k - 1]] if k else [])
        at = placed(belief.offsets, ways.key_poses[belief.keyframes])[:, :2]
        weights = belief.weights * (ways.groups[ways.of[belief.keyframes]] == ways.groups[drive])
        near = np.hypot(*(at - ways.poses[first + k, :2]).T) < ways.map.correlation_length
        here = (1.0 - belief.lost) * float(weights @ near)
        weights /= max(float(weights.sum()), 1e-12)
        found.append(
            (here, belief.lost, float(np.sqrt(weights @ np.square(at - weights @ at).sum(axis=1))))
        )
        advance()
    return Believed(*np.array(found).T)
