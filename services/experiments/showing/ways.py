"""The taught ways of a map: how they lie to each other, where they part and meet, what the filter believes on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from smal.demonstration import Demonstration
from smal.model import Model
from smal.movement import placed, seen_from
from smal.robot import Localizer
from smal.stitches import in_common_axes
from smal.visual_map import VisualMap


@dataclass(frozen=True)
class Parting:
    """Where ways that are shared part (a fork), or meet, and the last or first keyframe of one that is shared."""

    fork: bool
    keyframe: int
    drives: tuple[int, ...]


class Ways:
    """The taught ways of a map.

    Attributes
    ----------
    of : int array (k,)
        Drive of each keyframe.
    key_poses, poses : float64 arrays (k, 3), (f, 3)
        Of every keyframe and taught frame, in axes that all drives of a group have in common.
    groups : int array (drives,)
        Drives that are joined, directly or by others, have the same number; from 0.
    shared : bool array (k,)
        Which keyframes show a place that another drive shows too.
    """

    def __init__(self, taught: VisualMap) -> None:
        self.map = taught
        self.of = taught.drives[taught.keyframes]
        self.key_poses = in_common_axes(taught)
        first = np.searchsorted(self.of, taught.drives)
        self.poses = placed(seen_from(taught.poses, taught.key_poses[first]), self.key_poses[first])
        one, other = self.of[taught.stitched].T
        drives = len(taught.goals)
        _, self.groups = connected_components(coo_array((np.ones(one.size), (one, other)), (drives, drives)), False)
        self.shared = np.isin(np.arange(len(self.of)), taught.stitched)

    @property
    def unit(self) -> str:
        """Of lengths."""
        return "m" if self.map.odometry else "atoms ahead"

    @cached_property
    def way(self) -> NDArray[np.float64]:
        """Way from the start of its drive to each frame, (f,)."""
        way: NDArray[np.float64] = self.map.arc - self.map.arc[np.searchsorted(self.map.drives, self.map.drives)]
        return way

    @cached_property
    def partings(self) -> tuple[Parting, ...]:
        """Where shared ways part or meet; within a correlation length it is one place."""
        found: list[Parting] = []
        for one, other in np.unique(self.of[self.map.stitched], axis=0).tolist():
            for fork, keyframe in self._partings_of(one, other):
                new = Parting(fork, keyframe, (one, other))
                known = next((each for each in found if self._is_same(each, new)), None)
                if known is not None:
                    found.remove(known)
                    new = Parting(fork, min(keyframe, known.keyframe), (*known.drives, one, other))
                found.append(Parting(fork, new.keyframe, tuple(sorted(set(new.drives)))))
        return tuple(sorted(found, key=lambda parting: parting.keyframe))

    def _is_same(self, one: Parting, other: Parting) -> bool:
        apart = self.key_poses[one.keyframe, :2] - self.key_poses[other.keyframe, :2]
        near = bool(np.hypot(*apart) < self.map.correlation_length)
        return near and one.fork == other.fork and bool(set(one.drives) & set(other.drives))

    def _partings_of(self, one: int, other: int) -> Iterator[tuple[bool, int]]:
        """Yield where a drive leaves another (True) or comes to it (False), and the keyframe there.

        Where it is not stitched to the other but stays within a correlation length of it, it has not left it. Neither
        has it where the other one ends.
        """
        here = np.flatnonzero(self.of == one)
        pairs = self.map.stitched[(self.of[self.map.stitched] == (one, other)).all(axis=1)]
        partner = dict(pairs.tolist())
        far = self._apart(here, other) > self.map.correlation_length
        joints = np.flatnonzero(np.isin(here, pairs[:, 0]))
        for before, after in zip([-1, *joints], [*joints, len(here)], strict=True):
            if not far[before + 1 : after].any():
                continue
            if before >= 0 and self._goes_elsewhere(partner[int(here[before])], one, ahead=True):
                yield True, int(here[before])
            if after < len(here) and self._goes_elsewhere(partner[int(here[after])], one, ahead=False):
                yield False, int(here[after])

    def _goes_elsewhere(self, keyframe: int, other: int, *, ahead: bool) -> bool:
        """Whether the drive of a keyframe, on or back from it, is ever far from another: it does not end here."""
        own = np.flatnonzero(self.of == self.of[keyframe])
        rest = own[own > keyframe] if ahead else own[own < keyframe]
        return bool((self._apart(rest, other) > self.map.correlation_length).any())

    def _apart(self, keyframes: NDArray[np.intp], drive: int) -> NDArray[np.float64]:
        """Return how far keyframes are from the way of a drive."""
        way = KDTree(self.key_poses[self.of == drive, :2])
        return np.asarray(way.query(self.key_poses[keyframes, :2])[0])


@dataclass(frozen=True, eq=False)
class Believed:
    """Of each frame of a drive, where the belief was, float64 arrays (f,).

    ``here`` is the probability of being within a correlation length of where the robot was, ``lost`` of being nowhere
    near what was taught; the rest lay elsewhere on the taught ways. ``spread`` is the standard deviation of the place,
    given that the robot is on this drive or one that is joined to it.
    """

    here: NDArray[np.float64]
    lost: NDArray[np.float64]
    spread: NDArray[np.float64]

    def wide(self) -> list[tuple[int, int]]:
        """Return first and last frame of each stretch on which the robot was less likely here than not."""
        edges = np.diff((self.here < 0.5).astype(int), prepend=0, append=0)
        return list(zip(np.flatnonzero(edges > 0).tolist(), (np.flatnonzero(edges < 0) - 1).tolist(), strict=True))


def believed(model: Model, ways: Ways, drive: int, one: Demonstration, advance: Callable[[int], object]) -> Believed:
    """Let recognition follow a taught drive of the map from its beginning; advance is called with each frame."""
    localizer, found = Localizer(model), []
    first = int(np.searchsorted(ways.map.drives, drive))
    for k, features in enumerate(one.features):
        pose = None if one.odometry is None else one.odometry[k].tolist()
        belief = localizer.observe(features, pose, [one.atoms[k - 1]] if k else [])
        at = placed(belief.offsets, ways.key_poses[belief.keyframes])[:, :2]
        weights = belief.weights * (ways.groups[ways.of[belief.keyframes]] == ways.groups[drive])
        near = np.hypot(*(at - ways.poses[first + k, :2]).T) < ways.map.correlation_length
        here = (1.0 - belief.lost) * float(weights @ near)
        weights /= max(float(weights.sum()), 1e-12)
        found.append((here, belief.lost, float(np.sqrt(weights @ np.square(at - weights @ at).sum(axis=1)))))
        advance(k)
    return Believed(*np.array(found).T)
