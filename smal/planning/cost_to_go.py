"""The cost to go: how long the taught ways take from each keyframe to a goal, and what to follow from there.

The taught drives are a graph: keyframes, what follows each of them, and where drives meet (stitches). Dijkstra's
algorithm gives every keyframe its cost to go, the time to the nearest goal, and which drive to follow from there. So
drives are joined to ways that nobody drove in one piece, and a belief that is spread over drives wants one thing.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from smal.map import VisualMap
from smal.planning.config import PLANNER_CONFIG


def chosen_goal(goals: Sequence[str], goal: str | None) -> str:
    """Return the goal that is meant; ValueError where there is none of that name, or none is named of several."""
    known = sorted(set(goals))
    if goal is None and len(known) > 1:
        raise ValueError(f"the model has the goals {', '.join(known)}; name one of them")
    if goal is not None and goal not in known:
        raise ValueError(f"the model has no goal {goal!r}; it has {', '.join(known)}")
    return known[0] if goal is None else goal


def cost_to_go(
    visual_map: VisualMap,
    goal: str,
    go_over_s: float = PLANNER_CONFIG.go_over_s,
    tried: Iterable[int] = (),
    closed: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the seconds to the goal from every keyframe (k,), and the keyframe to go to next (k,).

    The goal is the end of each drive that leads there, but of those drives whose end was tried. From keyframes that are
    `closed` (k,) no drive goes on. Going over to another
    drive costs the time for the turn and the way between the two, and ``go_over_s``. The robot changes drives at
    the first place from which the goal is nearer by the other: at the last one it would be torn between both. The cost
    to go falls with every step, so that nobody goes in circles. Where no way leads on, it is infinite and nothing next
    (-1), as at goals.
    """
    count = len(visual_map.keyframes)
    of = visual_map.key_drives
    on = np.flatnonzero((of[:-1] == of[1:]) & (True if closed is None else ~closed[:-1]))
    leads = (visual_map.key_goals == goal) & ~np.isin(of, [*tried])
    goals = np.flatnonzero(np.append(of[:-1] != of[1:], True) & leads)
    source, target = visual_map.stitched.T
    steps = np.diff([visual_map.arc[visual_map.keyframes], np.unwrap(visual_map.key_poses[:, 2])])[
        :, on
    ]
    aside = visual_map.stitch_offsets[:, :2]
    turned = visual_map.stitch_offsets[:, 2]
    # From a node beyond all goals, against the way; 1e-9, since a sparse matrix has no edges of cost 0.
    rows = np.concatenate([on + 1, target, np.full(goals.size, count)])
    columns = np.concatenate([on, source, goals])
    ahead = max(float(np.abs(visual_map.movements[:, 0]).max()), 1e-9)
    turn_rad = visual_map.turn_rad
    way = np.append(steps[0], np.hypot(*aside.T))
    turns = np.abs(np.append(steps[1], turned))
    costs = (way / ahead + turns / turn_rad) * visual_map.tick_s
    costs[on.size :] += go_over_s
    costs = np.maximum(np.append(costs, np.zeros(goals.size)), 1e-9)
    graph = sparse.csr_array((costs, (rows, columns)), shape=(count + 1, count + 1))
    found, previous = dijkstra(graph, indices=np.array([count]), return_predecessors=True)
    to_go_s = found[0, :-1]
    following = previous[0, :-1].astype(np.intp)
    following[(following == count) | (following < 0)] = -1
    goes_over_to = of.copy()
    for here in np.argsort(to_go_s):
        then = following[here]
        if then >= 0:
            goes_over_to[here] = of[then] if of[then] != of[here] else goes_over_to[then]
    for one, other in visual_map.stitched:
        if goes_over_to[one] == of[other] and to_go_s[other] < to_go_s[one]:
            following[one] = other
    return to_go_s, following
