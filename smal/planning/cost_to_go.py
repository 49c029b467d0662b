"""Cost to go: time along the taught ways from each keyframe to a goal, and the next keyframe on the way.

The taught drives are a graph: keyframes, their successors, and the stitches where drives meet. Dijkstra's algorithm
computes for every keyframe the time to the nearest goal and the drive to follow. Drives are joined to ways that were
never driven in one piece, and a belief that is spread over several drives has one aim.
"""

from collections.abc import Iterable

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from smal.arrays import Bools, Floats, Indices
from smal.map import VisualMap
from smal.planning.config import PLANNER_CONFIG


def cost_to_go(
    visual_map: VisualMap,
    goal: str,
    go_over_s: float = PLANNER_CONFIG.go_over_s,
    tried: Iterable[int] = (),
    closed: Bools | None = None,
) -> tuple[Floats, Indices]:
    """Compute the time to the goal from every keyframe, and the next keyframe.

    The robot changes drives at the first place from which the goal is nearer by the other drive. The time decreases
    with every step, so that the robot never drives in circles.

    Parameters
    ----------
    visual_map : VisualMap
    goal : str
    go_over_s : float
        Extra cost of changing drives, seconds, besides the turn and the way between them.
    tried : iterable of int
        Drives to the goal with an end that was visited in vain.
    closed : array (k,), optional
        Keyframes from which no drive goes on.

    Returns
    -------
    to_go_s : array (k,)
        Seconds; infinite without a way.
    following : array (k,)
        Next keyframe; -1 at goals and without a way.
    """
    count = len(visual_map.keyframes)
    to_go_s, following = _shortest(visual_map, goal, go_over_s, tried, closed)
    following[(following == count) | (following < 0)] = -1
    drives = visual_map.key_drives
    goes_over_to = drives.copy()
    for key in np.argsort(to_go_s):
        after = following[key]
        if after >= 0:
            stays = drives[after] == drives[key]
            goes_over_to[key] = goes_over_to[after] if stays else drives[after]
    for one, other in visual_map.stitched:
        if goes_over_to[one] == drives[other] and to_go_s[other] < to_go_s[one]:
            following[one] = other
    return to_go_s, following


def _shortest(
    visual_map: VisualMap,
    goal: str,
    go_over_s: float,
    tried: Iterable[int],
    closed: Bools | None,
) -> tuple[Floats, Indices]:
    """Run Dijkstra's algorithm from a virtual node beyond all goals, against the direction of driving."""
    count = len(visual_map.keyframes)
    drives = visual_map.key_drives
    same_drive = drives[:-1] == drives[1:]
    on = np.flatnonzero(same_drive if closed is None else same_drive & ~closed[:-1])
    leads = (visual_map.key_goals == goal) & ~np.isin(drives, [*tried])
    goals = np.flatnonzero(np.append(~same_drive, True) & leads)
    source, target = visual_map.stitched.T
    rows = np.concatenate([on + 1, target, np.full(goals.size, count)])
    columns = np.concatenate([on, source, goals])
    arc = visual_map.arc[visual_map.keyframes]
    heading = np.unwrap(visual_map.key_poses[:, 2])
    offsets = visual_map.stitch_offsets
    way = np.append(np.diff(arc)[on], np.hypot(*offsets[:, :2].T))
    turns = np.abs(np.append(np.diff(heading)[on], offsets[:, 2]))
    ahead = max(float(np.abs(visual_map.movements[:, 0]).max()), 1e-9)
    costs = (way / ahead + turns / visual_map.turn_rad) * visual_map.tick_s
    costs[on.size :] += go_over_s
    # A sparse matrix has no edges of cost 0.
    costs = np.maximum(np.append(costs, np.zeros(goals.size)), 1e-9)
    graph = sparse.csr_array((costs, (rows, columns)), shape=(count + 1, count + 1))
    found, previous = dijkstra(graph, indices=np.array([count]), return_predecessors=True)
    return found[0, :-1], previous[0, :-1].astype(np.intp)
