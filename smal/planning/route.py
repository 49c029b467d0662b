"""The route: for every keyframe the cost to go, the drive to follow, and where that leads.

A route is a pure function of the map, the goal, the ends that were tried in vain, and the keyframes that are closed.
"""

from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from smal.filter import Belief
from smal.map import VisualMap, in_common_axes, way_from
from smal.movement import placed, seen_from, wrapped
from smal.planning.cost_to_go import cost_to_go

Floats = NDArray[np.float64]
#: Nearer to the aim than this share of the lookahead, the direction to it is noise: the aim's heading counts.
_NEAR_AIM = 0.3


class Aims(NamedTuple):
    """Where the particles (p,) of a belief aim, in the map's unit and radians."""

    directions: Floats  # From the robot's heading to the aim, positive to the left.
    left_to_go: Floats  # Along the drive to its end; negative beyond the end.
    to_end: Floats  # Straight to the end of the drive.


@dataclass(frozen=True)
class Route:
    """The shortest taught ways to a goal.

    Attributes
    ----------
    go_over_s
        What going over to another drive must save, seconds.
    to_go_s
        Seconds to the goal from each keyframe (k,); infinite where no way leads there.
    guide
        For each keyframe (k,) the keyframe whose drive is to be followed from there.
    offset
        Pose of each keyframe as seen from its guide (k, 3).
    leads
        Whether the followed drive ends at the goal and was not tried (k,).
    tried, closed
        The drives whose ends were tried, and the keyframes (k,) from which no drive goes on.
    """

    taught: VisualMap
    goal: str
    go_over_s: float
    to_go_s: Floats
    guide: NDArray[np.intp]
    offset: Floats
    leads: NDArray[np.bool_]
    tried: frozenset[int]
    closed: NDArray[np.bool_]

    @classmethod
    def plan(
        cls,
        taught: VisualMap,
        goal: str,
        go_over_s: float,
        tried: AbstractSet[int] = frozenset(),
        closed: NDArray[np.bool_] | None = None,
    ) -> "Route":
        """Plan the ways from all keyframes."""
        closed = np.zeros(len(taught.keyframes), dtype=np.bool_) if closed is None else closed
        to_go_s, following = cost_to_go(taught, goal, go_over_s, tried, closed)
        guide, offset = _guides(taught, to_go_s, following)
        leads = (taught.key_goals[guide] == goal) & ~np.isin(taught.key_drives[guide], [*tried])
        return cls(taught, goal, go_over_s, to_go_s, guide, offset, leads, frozenset(tried), closed)

    def leads_on(self, belief: Belief) -> NDArray[np.bool_]:
        """Return from which particles (p,) a way leads to the goal."""
        return np.isfinite(self.to_go_s[belief.keyframes])

    def has_way(self, belief: Belief) -> bool:
        """Return whether a way leads to the goal from where the robot probably is."""
        return float(belief.weights @ self.leads_on(belief)) >= 0.5

    def aims(self, belief: Belief, lookahead: float) -> Aims:
        """Return where each particle aims: at the followed drive, by ``lookahead`` further along."""
        taught = self.taught
        guide = self.guide[belief.keyframes]
        key = taught.keyframes[guide]
        drive = taught.key_drives[guide]
        ahead, left, turned = placed(belief.offsets, self.offset[belief.keyframes]).T
        along = taught.arc[key] + ahead
        start = np.searchsorted(taught.drives, drive, "left")
        end = np.searchsorted(taught.drives, drive, "right")
        # Frames of other drives, in axes of their own, come before and after.
        target = np.clip(np.searchsorted(taught.arc, along + lookahead), start, end - 1)
        aim_ahead, aim_left, aim_turned = seen_from(taught.poses[target], taught.poses[key]).T
        x = aim_ahead - ahead
        y = aim_left - left
        near = np.hypot(x, y) < _NEAR_AIM * lookahead
        direction = np.where(near, aim_turned, np.arctan2(y, x))
        last_ahead, last_left, _ = seen_from(taught.poses[end - 1], taught.poses[key]).T
        return Aims(
            wrapped(direction - turned),
            taught.arc[end - 1] - along,
            np.hypot(last_ahead - ahead, last_left - left),
        )

    def way_ahead(self, belief: Belief, lookahead: float, reach: float) -> Floats:
        """Return points (s, 2) of the way from its aim on, ahead of and left of the robot's likeliest place."""
        best = belief.weights.argmax()
        here = belief.keyframes[best]
        along = np.arange(lookahead, lookahead + reach, max(lookahead / 4.0, reach / 100.0))
        return way_from(
            self.taught, self.guide[here], placed(belief.offsets[best], self.offset[here]), along
        )

    def ends_near(self, belief: Belief, distance: float) -> frozenset[int]:
        """Return the drives that end where the robot probably is, and those that end within a distance of there."""
        taught = self.taught
        poses = in_common_axes(taught)
        here = int(taught.key_drives[self._guide_of(belief)])
        last = np.unique(taught.key_range[1])
        away = np.hypot(*(poses[last] - poses[last[taught.key_drives[last] == here]])[:, :2].T)
        # Drives that share no place are in axes of their own.
        one, other = taught.key_drives[taught.stitched].T
        links = sparse.csr_array((np.ones(one.size), (one, other)), shape=(len(taught.goals),) * 2)
        group = connected_components(links, directed=False)[1]
        near = (away < distance) & (group[taught.key_drives[last]] == group[here])
        return frozenset(taught.key_drives[last[near]].tolist()) | {here}

    def beyond(self, tried: AbstractSet[int]) -> "Route":
        """Return the route to the ends that are left when those of some drives were tried."""
        return Route.plan(self.taught, self.goal, self.go_over_s, self.tried | tried, self.closed)

    def around(self, belief: Belief, reach: float) -> "Route | None":
        """Return the route without the next ``reach`` of the way; None if none leads on from where the robot is."""
        taught = self.taught
        here = self._guide_of(belief)
        along = taught.arc[taught.keyframes] - taught.arc[taught.keyframes[here]]
        ahead = (taught.key_drives == taught.key_drives[here]) & (along >= 0.0) & (along < reach)
        other = Route.plan(taught, self.goal, self.go_over_s, self.tried, self.closed | ahead)
        return other if other.has_way(belief) else None

    def reopened(self) -> "Route":
        """Return the route on which all keyframes are open again."""
        return Route.plan(self.taught, self.goal, self.go_over_s, self.tried)

    def _guide_of(self, belief: Belief) -> int:
        return int(self.guide[belief.keyframes[belief.weights.argmax()]])


def _guides(
    taught: VisualMap, to_go_s: Floats, following: NDArray[np.intp]
) -> tuple[NDArray[np.intp], Floats]:
    """Return for each keyframe the one whose drive is to be followed there, and its own pose as seen from that one."""
    guide = np.arange(len(following))
    offset = np.zeros((len(following), 3))
    stitch = {(one, other): k for k, (one, other) in enumerate(taught.stitched.tolist())}
    for start in np.argsort(
        to_go_s
    ).tolist():  # Each one's follower is nearer to the goal, so it comes first.
        then = int(following[start])
        if (start, then) in stitch:
            guide[start] = guide[then]
            offset[start] = placed(taught.stitch_offsets[stitch[start, then]], offset[then])
    return guide, offset
