"""The route: for every keyframe the cost to go, the drive to follow, and its aim.

A route is a pure function of the map, the goal, the ends that were visited in vain, and the closed keyframes.
"""

from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from smal.arrays import Bools, Floats, Indices, Int32s
from smal.filter import Belief
from smal.map import VisualMap, in_common_axes, way_from
from smal.movement import placed, seen_from, wrapped
from smal.planning.cost_to_go import cost_to_go

#: Nearer to the aim than this share of the lookahead, the direction to it is noise, and the aim's heading counts.
_NEAR_AIM = 0.3


class Aims(NamedTuple):
    """Aims of the particles (p,) of a belief, in the map's unit and radians."""

    #: From the robot's heading to the aim, positive to the left.
    directions: Floats
    #: Along the drive to its end; negative beyond the end.
    left_to_go: Floats
    #: Straight to the end of the drive.
    to_end: Floats


@dataclass(frozen=True)
class Route:
    """The shortest taught ways to a goal.

    Attributes
    ----------
    go_over_s
        Minimum saving for changing drives, seconds.
    to_go_s
        Seconds to the goal from each keyframe (k,); infinite without a way.
    guide
        For each keyframe (k,) the keyframe whose drive is followed from there.
    offset
        Pose of each keyframe relative to its guide (k, 3).
    leads
        Whether the followed drive ends at the goal and was not tried (k,).
    tried, closed
        Drives whose ends were tried, and keyframes (k,) from which no drive goes on.
    """

    taught: VisualMap
    goal: str
    go_over_s: float
    to_go_s: Floats
    guide: Indices
    offset: Floats
    leads: Bools
    tried: frozenset[int]
    closed: Bools

    @classmethod
    def plan(
        cls,
        taught: VisualMap,
        goal: str,
        go_over_s: float,
        tried: AbstractSet[int] = frozenset(),
        closed: Bools | None = None,
    ) -> "Route":
        """Plan the ways from all keyframes."""
        if closed is None:
            closed = np.zeros(len(taught.keyframes), dtype=np.bool_)
        to_go_s, following = cost_to_go(taught, goal, go_over_s, tried, closed)
        guide, offset = _guides(taught, to_go_s, following)
        was_tried = np.isin(taught.key_drives[guide], [*tried])
        leads = (taught.key_goals[guide] == goal) & ~was_tried
        return cls(taught, goal, go_over_s, to_go_s, guide, offset, leads, frozenset(tried), closed)

    def leads_on(self, belief: Belief) -> Bools:
        """Return which particles (p,) have a way to the goal."""
        return np.isfinite(self.to_go_s[belief.keyframes])

    def has_way(self, belief: Belief) -> bool:
        """Return whether a way leads to the goal from the robot's probable place."""
        return belief.share(np.isfinite(self.to_go_s)) >= 0.5

    def aims(self, belief: Belief, lookahead: float) -> Aims:
        """Return the aim of each particle: on the followed drive, ``lookahead`` further along."""
        taught = self.taught
        guide = self.guide[belief.keyframes]
        key = taught.keyframes[guide]
        last = taught.keyframes[taught.key_range[1][guide]]
        ahead, left, turned = placed(belief.offsets, self.offset[belief.keyframes]).T
        along = taught.arc[key] + ahead
        target = taught.frames_along(guide, along + lookahead)
        pose = taught.poses[key]
        aim_ahead, aim_left, aim_turned = seen_from(taught.poses[target], pose).T
        x = aim_ahead - ahead
        y = aim_left - left
        near = np.hypot(x, y) < _NEAR_AIM * lookahead
        direction = np.where(near, aim_turned, np.arctan2(y, x))
        last_ahead, last_left, _ = seen_from(taught.poses[last], pose).T
        return Aims(
            directions=wrapped(direction - turned),
            left_to_go=taught.arc[last] - along,
            to_end=np.hypot(last_ahead - ahead, last_left - left),
        )

    def way_ahead(self, belief: Belief, lookahead: float, reach: float) -> Floats:
        """Return points (s, 2) of the way beyond the aim, ahead and left of the robot's most likely place."""
        best = belief.weights.argmax()
        key = belief.keyframes[best]
        spacing = max(lookahead / 4.0, reach / 100.0)
        along = np.arange(lookahead, lookahead + reach, spacing)
        offset = placed(belief.offsets[best], self.offset[key])
        return way_from(self.taught, self.guide[key], offset, along)

    def ends_near(self, belief: Belief, distance: float) -> frozenset[int]:
        """Return the followed drive, and the drives that end within a distance of its end."""
        taught = self.taught
        poses = in_common_axes(taught)
        followed = int(taught.key_drives[self._guide_of(belief)])
        last = np.unique(taught.key_range[1])
        drives = taught.key_drives[last]
        end = poses[last[drives == followed]]
        away = np.hypot(*(poses[last] - end)[:, :2].T)
        # Drives that share no place are in different axes.
        group = _connected(taught)
        near = (away < distance) & (group[drives] == group[followed])
        return frozenset(drives[near].tolist()) | {followed}

    def beyond(self, tried: AbstractSet[int]) -> "Route":
        """Return the route without the ends of some more drives."""
        return Route.plan(self.taught, self.goal, self.go_over_s, self.tried | tried, self.closed)

    def around(self, belief: Belief, reach: float) -> "Route | None":
        """Return the route without the next ``reach`` of the way; None if the robot then has no way."""
        taught = self.taught
        guide = self._guide_of(belief)
        arc = taught.arc[taught.keyframes]
        along = arc - arc[guide]
        same_drive = taught.key_drives == taught.key_drives[guide]
        ahead = same_drive & (along >= 0.0) & (along < reach)
        other = Route.plan(taught, self.goal, self.go_over_s, self.tried, self.closed | ahead)
        return other if other.has_way(belief) else None

    def reopened(self) -> "Route":
        """Return the route without closed keyframes."""
        return Route.plan(self.taught, self.goal, self.go_over_s, self.tried)

    def _guide_of(self, belief: Belief) -> int:
        return int(self.guide[belief.keyframes[belief.weights.argmax()]])


def _guides(taught: VisualMap, to_go_s: Floats, following: Indices) -> tuple[Indices, Floats]:
    """Return for each keyframe its guide, and its own pose relative to the guide."""
    guide = np.arange(len(following))
    offset = np.zeros((len(following), 3))
    pairs = map(tuple, taught.stitched.tolist())
    stitches = dict(zip(pairs, taught.stitch_offsets, strict=True))
    # A successor is nearer to the goal than its predecessor, so it comes first.
    for key in np.argsort(to_go_s).tolist():
        after = int(following[key])
        stitch = stitches.get((key, after))
        if stitch is not None:
            guide[key] = guide[after]
            offset[key] = placed(stitch, offset[after])
    return guide, offset


def _connected(taught: VisualMap) -> Int32s:
    """Return the group of each drive (d,); drives of one group are linked by shared places."""
    count = taught.drive_count
    one, other = taught.key_drives[taught.stitched].T
    links = sparse.csr_array((np.ones(one.size), (one, other)), shape=(count, count))
    _, group = connected_components(links, directed=False)
    return np.asarray(group)
