"""Where taught drives share a place, and how the robot seen from one of them stands in the other.

The paper shares states between demonstrations where sequences of frames are alike (Algorithm 1); without that its graph
is a set of chains, on which no decision can be taken. We share places: two keyframes of different drives are one place
where each is the other's likeliest view, more alike than unrelated places, and so are their neighbours, in order, for
a whole correlation length. The virtual view that fits best tells how the one stands to the other, as exactly as virtual
views are dense; by the wheels what all pairs about a place tell becomes one.

Two corners of a town may look alike for longer than that. So the wheels have to allow it: once two drives share their
longest stretch, it is known how their axes lie to each other, and from there both drives must lead to whatever else
they share, as far as their odometry can be trusted.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from smal.camera import STEP_DEG, STRAIGHT
from smal.likelihood import ANY_DAY, standing_out
from smal.model import VisualMap
from smal.movement import BY_ATOMS, BY_ODOMETRY, placed, seen_from, wrapped
from smal.settings import SETTINGS

#: A keyframe, one of another drive, and where a robot at the first is as seen from the second: ahead, left, turned.
_Stitch = tuple[int, int, tuple[float, float, float]]


def stitched(visual_map: VisualMap) -> VisualMap:
    """Return a map with the places that its drives share; none where there is one drive."""
    found: list[_Stitch] = []
    names = np.unique(visual_map.key_drives)
    if names.size > 1:
        best = _best_of_each_drive(visual_map, names)
        for one in names:
            for other in names[names != one]:
                runs = _chained(visual_map, best, int(one), int(other))
                found.extend(_joined(visual_map, _reachable(visual_map, runs)))
    found.sort(key=lambda stitch: stitch[:2])
    return replace(
        visual_map,
        stitched=np.array([stitch[:2] for stitch in found], dtype=np.int32).reshape(-1, 2),
        stitch_offsets=np.array([stitch[2] for stitch in found], dtype=np.float64).reshape(-1, 3),
    )


def in_common_axes(visual_map: VisualMap) -> NDArray[np.float64]:
    """Return the poses of all keyframes (k, 3), those of drives that share a place in the axes of the first of them.

    A drive that shares none stays in its own. For people, and for pictures: odometry has drifted on the way.
    """
    poses = visual_map.key_poses.copy()
    drives = visual_map.key_drives
    one, other = visual_map.stitched.T
    known = np.zeros(len(visual_map.goals), dtype=bool)
    for first in range(len(visual_map.goals)):
        if known[first]:
            continue
        known[first] = True
        # One drive at a time is moved to where a place that it shares is known to be.
        while (ready := np.flatnonzero(~known[drives[one]] & known[drives[other]])).size:
            stitch = ready[0]
            mine = drives == drives[one[stitch]]
            there = placed(visual_map.stitch_offsets[stitch], poses[other[stitch]])
            poses[mine] = placed(seen_from(poses[mine], poses[one[stitch]]), there)
            known[drives[one[stitch]]] = True
    return poses


@dataclass(frozen=True, eq=False)
class _Best:
    """For each keyframe and drive: the likeliest keyframe there (-1: none is likely), and how it stands to it."""

    keyframe: NDArray[np.intp]
    left: NDArray[np.float64]
    turned: NDArray[np.float64]


def _best_of_each_drive(visual_map: VisualMap, names: NDArray[np.int32]) -> _Best:
    count = len(visual_map.keyframes)
    keyframe = np.full((count, int(names.max()) + 1), -1, dtype=np.intp)
    left, turned = np.zeros(keyframe.shape), np.zeros(keyframe.shape)
    for first in range(0, count, SETTINGS.compared_at_once):
        views = visual_map.views[first : first + SETTINGS.compared_at_once, 1, STRAIGHT]
        cosines = (visual_map.flat_views @ views.T).reshape(*visual_map.views.shape[:3], -1)
        ratio = np.stack(
            [
                visual_map.likelihood.mixed(ANY_DAY, standing_out(each, visual_map.sampled(each)), 1.0)
                for each in np.moveaxis(cosines, -1, 0)
            ]
        )
        for name in names:
            there = np.flatnonzero(visual_map.key_drives == name)
            each = cosines[there].reshape(-1, views.shape[0])
            at = each.argmax(axis=0)
            k, p, t = np.unravel_index(at, (there.size, *visual_map.views.shape[1:3]))
            for row in range(views.shape[0]):
                if ratio[row, there[k[row]], p[row], t[row]] > 1.0:
                    grid = cosines[there[k[row]], :, :, row]
                    keyframe[first + row, name] = there[k[row]]
                    left[first + row, name] = (_peak(grid[:, t[row]], int(p[row])) - 1.0) * visual_map.aside
                    turn = _peak(grid[p[row]], int(t[row])) - STRAIGHT
                    turned[first + row, name] = math.radians(turn * STEP_DEG)
    return _Best(keyframe, left, turned)


def _peak(values: NDArray[np.float32], at: int) -> float:
    """Return where the parabola through the largest value and its neighbours is highest."""
    middle = min(max(at, 1), values.size - 2)
    before, here, after = (float(values[middle + k]) for k in (-1, 0, 1))
    curve = before - 2.0 * here + after
    if curve >= 0.0:
        return float(at)
    return min(max(middle + 0.5 * (before - after) / curve, 0.0), values.size - 1.0)


def _chained(visual_map: VisualMap, best: _Best, one: int, other: int) -> list[list[_Stitch]]:
    """Return the runs of mutual pairs of two drives that go on in order for a correlation length."""
    here = np.flatnonzero(visual_map.key_drives == one)
    there = best.keyframe[here, other]
    back = np.where(there >= 0, best.keyframe[np.maximum(there, 0), one], -1)
    mutual = (there >= 0) & (back >= 0) & (np.abs(back - here) <= SETTINGS.advance)
    goes_on = mutual[:-1] & mutual[1:] & (np.diff(there) >= 0) & (np.diff(there) <= SETTINGS.advance)
    breaks = np.flatnonzero(~goes_on) + 1
    runs = np.split(np.arange(here.size), breaks)
    return [
        [
            (int(here[k]), int(there[k]), (0.0, float(best.left[here[k], other]), float(best.turned[here[k], other])))
            for k in run
        ]
        for run in runs
        if run.size > SETTINGS.views_a_length
    ]


def _reachable(visual_map: VisualMap, runs: list[list[_Stitch]]) -> list[_Stitch]:
    """Return the stitches of those runs to which both drives lead from the longest one, as the wheels tell."""
    kept: list[list[_Stitch]] = []
    for run in sorted(runs, key=len, reverse=True):
        pairs = [(there, here) for other in kept for there in (other[0], other[-1]) for here in (run[0], run[-1])]
        apart = [_off(visual_map, *pair) for pair in pairs]
        # From the nearest stretch, where the least of drifting has happened.
        if not apart or min(apart)[1] < SETTINGS.trusted:
            kept.append(run)
    return [stitch for run in kept for stitch in run]


def _joined(visual_map: VisualMap, stitches: list[_Stitch]) -> list[_Stitch]:
    """Return stitches for all keyframes of a stretch that two drives share, from those that were found there.

    Within a correlation length before and after each, the axes of the one drive are turned and moved against those of
    the other as the mean of the stitches says. With each stitch by itself the way that is to be followed would jump
    from one keyframe to the next, and the robot turn to and fro.
    """
    if not stitches:
        return []
    poses, arc = visual_map.key_poses, visual_map.arc[visual_map.keyframes]
    here, there = (np.array([stitch[k] for stitch in stitches]) for k in (0, 1))
    robot = placed(np.array([stitch[2] for stitch in stitches]), poses[there])
    others = np.flatnonzero(visual_map.key_drives == visual_map.key_drives[there[0]])
    joined: list[_Stitch] = []
    for k in range(int(here.min()), int(here.max()) + 1):
        near = np.abs(arc[here] - arc[k]) < visual_map.correlation_length
        if not ((here[near] <= k).any() and (here[near] >= k).any()):
            continue
        turns = robot[near, 2] - poses[here[near], 2]
        turn = turns[0] + np.mean(wrapped(turns - turns[0]))
        # A rigid movement of the axes: where their origin goes, by each stitch.
        frame = np.array([*poses[k, :2], 0.0])
        moved = placed(seen_from(poses[here[near]], frame), np.array([0.0, 0.0, turn]))
        pose = np.append(np.mean(robot[near, :2] - moved[:, :2], axis=0), poses[k, 2] + turn)
        beside = others[(others >= there[near].min()) & (others <= there[near].max())]
        nearest = int(beside[np.hypot(*(poses[beside] - pose)[:, :2].T).argmin()])
        ahead, left, turned = seen_from(pose, poses[nearest]).tolist()
        joined.append((k, nearest, (ahead, left, turned)))
    return joined


def _off(visual_map: VisualMap, one: _Stitch, other: _Stitch) -> tuple[float, float]:
    """Return the way between two stitches, and by how many standard deviations of odometry the drives disagree."""
    noise = BY_ODOMETRY if visual_map.odometry else BY_ATOMS
    poses, length = visual_map.key_poses, visual_map.correlation_length
    here, there = (placed(np.array(stitch[2]), poses[stitch[1]]) for stitch in (one, other))
    by_one = seen_from(poses[other[0]], poses[one[0]])
    by_other = seen_from(there, here)
    off, turned = by_other[:2] - by_one[:2], float(wrapped(by_other[2:] - by_one[2:])[0])
    way, turns = 0.0, 0.0
    for first, last in (sorted((one[0], other[0])), sorted((one[1], other[1]))):
        steps = poses[first : last + 1]
        way += float(np.hypot(*np.diff(steps[:, :2], axis=0).T).sum())
        turns += float(np.abs(wrapped(np.diff(steps[:, 2]))).sum())
    # A single stitch is as exact as virtual views are dense, and along the way as views tell places apart.
    heading = math.sqrt(
        math.radians(SETTINGS.drift_deg) ** 2 * way / length + (noise.turn * turns) ** 2 + math.radians(STEP_DEG) ** 2
    )
    distance = math.hypot(noise.pace * way, heading * float(np.hypot(*by_one[:2])), length)
    return way, max(float(np.hypot(*off)) / distance, abs(turned) / heading)
