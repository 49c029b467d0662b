"""Where taught drives meet, and how the robot seen from one of them stands in the other.

The paper shares states between demonstrations where sequences of frames are alike (Algorithm 1). We share keyframes:
two of different drives show one place where each is the other's likeliest view, more alike than unrelated places, and
so are their neighbours, in order, for a whole correlation length. The virtual view that fits best tells how the one
stands to the other; by the wheels what all pairs about a place tell becomes one.

Two corners of a town may look alike for longer than that. So the wheels have to allow it: the longest stretch that two
drives share tells how their axes lie to each other, and from there both must lead to whatever else they share, as far
as their odometry can be trusted.
"""

import math
from dataclasses import replace
from itertools import permutations

import numpy as np

from smal.arrays import Float32s, Floats, Indices
from smal.camera import STEP_DEG, STRAIGHT
from smal.features.extraction import in_parallel
from smal.files.packed import BATCH, unpacked
from smal.likelihood import ANY_DAY, standing_out
from smal.map import VisualMap
from smal.movement import BY_ATOMS, BY_ODOMETRY, placed, seen_from, wrapped

#: A keyframe, one of another drive, and where a robot at the first is as seen from the second: ahead, left, turned.
_Stitch = tuple[int, int, list[float]]


def stitched(visual_map: VisualMap) -> VisualMap:
    """Return a map with the places that its drives share; none where there is one drive."""
    if len(visual_map.goals) == 1:
        return visual_map
    found: list[_Stitch] = []
    best, offsets = _best_of_each_drive(visual_map)
    for one, other in permutations(range(len(visual_map.goals)), 2):
        there = best[:, other]
        # Where a robot at each keyframe of the one drive is in the axes of the other.
        robot = placed(offsets[:, other], visual_map.key_poses[there])
        kept = _reachable(visual_map, _runs(visual_map, best, one, other), there, robot)
        if kept:
            found.extend(_joined(visual_map, np.concatenate(kept), there, robot))
    found.sort(key=lambda stitch: stitch[:2])
    return replace(
        visual_map,
        stitched=np.array([stitch[:2] for stitch in found], dtype=np.int32).reshape(-1, 2),
        stitch_offsets=np.array([stitch[2] for stitch in found], dtype=np.float64).reshape(-1, 3),
    )


def _best_of_each_drive(visual_map: VisualMap) -> tuple[Indices, Floats]:
    """Return for each keyframe the likeliest one of each drive (k, d), -1 where none is, and how it stands to that."""
    count = len(visual_map.keyframes)
    drives = visual_map.key_drives
    goals = len(visual_map.goals)
    best = np.full((count, goals), -1, dtype=np.intp)
    offsets = np.zeros((count, goals, 3))

    def compare(start: int) -> None:
        own = unpacked(visual_map.views[start : start + BATCH, 1, STRAIGHT])
        some = np.unique(np.concatenate([visual_map.likely(view)[0] for view in own]))
        views = unpacked(visual_map.views[some])
        together = (views.reshape(-1, own.shape[1]) @ own.T).reshape(*views.shape[:3], -1)
        for here, (view, cosines) in enumerate(
            zip(own, np.moveaxis(together, -1, 0), strict=True), start
        ):
            sample = visual_map.sample @ view
            for drive, first in zip(*np.unique(drives[some], return_index=True), strict=True):
                there = cosines[first : first + np.count_nonzero(drives[some] == drive)]
                k, p, t = map(int, np.unravel_index(there.argmax(), there.shape))
                if (
                    visual_map.likelihood.mixed(ANY_DAY, standing_out(there[k, p, t], sample), 1.0)
                    > 1.0
                ):
                    best[here, drive] = some[first + k]
                    left = (_peak(there[k, :, t], p) - 1.0) * visual_map.aside
                    turned = math.radians((_peak(there[k, p], t) - STRAIGHT) * STEP_DEG)
                    offsets[here, drive] = 0.0, left, turned

    for _ in in_parallel(compare, range(0, count, BATCH)):
        pass
    return best, offsets


def _peak(values: Float32s, at: int) -> float:
    """Return where the parabola through the largest value and its neighbours is highest."""
    middle = min(max(at, 1), values.size - 2)
    before, here, after = (float(values[middle + k]) for k in (-1, 0, 1))
    curve = before - 2.0 * here + after
    if curve >= 0.0:
        return float(at)
    return min(max(middle + 0.5 * (before - after) / curve, 0.0), values.size - 1.0)


def _runs(visual_map: VisualMap, best: Indices, one: int, other: int) -> list[Indices]:
    """Return the runs of mutual pairs of two drives that go on in order for a correlation length: keyframes of one."""
    here = np.flatnonzero(visual_map.key_drives == one)
    there = best[here, other]
    back = np.where(there >= 0, best[there, one], -1)
    mutual = (back >= 0) & (np.abs(back - here) <= visual_map.config.advance)
    goes_on = (
        mutual[:-1]
        & mutual[1:]
        & (np.diff(there) >= 0)
        & (np.diff(there) <= visual_map.config.advance)
    )
    runs = np.split(here, np.flatnonzero(~goes_on) + 1)
    return [run for run in runs if run.size > visual_map.config.views_a_length]


def _reachable(
    visual_map: VisualMap, runs: list[Indices], there: Indices, robot: Floats
) -> list[Indices]:
    """Return those runs to which both drives lead from the longest one, as the wheels tell."""
    kept: list[Indices] = []
    for run in sorted(runs, key=len, reverse=True):
        pairs = [
            (known, new)
            for other in kept
            for known in (other[0], other[-1])
            for new in (run[0], run[-1])
        ]
        apart = [_off(visual_map, there, robot, *pair) for pair in pairs]
        # From the nearest stretch, where the least of drifting has happened.
        if not apart or min(apart)[1] < visual_map.config.trusted:
            kept.append(run)
    return kept


def _off(
    visual_map: VisualMap, there: Indices, robot: Floats, one: int, other: int
) -> tuple[float, float]:
    """Return the way between two stitches, and by how many standard deviations of odometry the drives disagree."""
    noise = BY_ODOMETRY if visual_map.odometry else BY_ATOMS
    poses = visual_map.key_poses
    length = visual_map.correlation_length
    by_one = seen_from(poses[other], poses[one])
    by_other = seen_from(robot[other], robot[one])
    off = by_other[:2] - by_one[:2]
    turned = float(wrapped(by_other[2:] - by_one[2:])[0])
    way = 0.0
    turns = 0.0
    for first, last in (sorted((one, other)), sorted((there[one], there[other]))):
        steps = np.diff(poses[first : last + 1], axis=0)
        way += float(np.hypot(*steps[:, :2].T).sum())
        turns += float(np.abs(wrapped(steps[:, 2])).sum())
    # A single stitch is as exact as virtual views are dense, and along the way as views tell places apart.
    heading = math.sqrt(
        math.radians(noise.drift_deg) ** 2 * way / length
        + (noise.turn * turns) ** 2
        + math.radians(STEP_DEG) ** 2
    )
    distance = math.hypot(noise.pace * way, heading * float(np.hypot(*by_one[:2])), length)
    return way, max(float(np.hypot(*off)) / distance, abs(turned) / heading)


def _joined(visual_map: VisualMap, here: Indices, there: Indices, robot: Floats) -> list[_Stitch]:
    """Return stitches for all keyframes of a stretch that two drives share, from those that were found there.

    Within a correlation length before and after each, the axes of the one drive are turned and moved against those of
    the other as the mean of the stitches says. With each stitch by itself the way that is to be followed would jump
    from one keyframe to the next, and the robot turn to and fro.
    """
    poses = visual_map.key_poses
    arc = visual_map.arc[visual_map.keyframes]
    others = np.flatnonzero(visual_map.key_drives == visual_map.key_drives[there[here[0]]])
    joined: list[_Stitch] = []
    for k in range(int(here.min()), int(here.max()) + 1):
        near = here[np.abs(arc[here] - arc[k]) < visual_map.correlation_length]
        if not ((near <= k).any() and (near >= k).any()):
            continue
        turns = robot[near, 2] - poses[near, 2]
        turn = turns[0] + np.mean(wrapped(turns - turns[0]))
        # A rigid movement of the axes: where their origin goes, by each stitch.
        moved = placed(
            seen_from(poses[near], np.array([*poses[k, :2], 0.0])), np.array([0.0, 0.0, turn])
        )
        pose = np.append(np.mean(robot[near, :2] - moved[:, :2], axis=0), poses[k, 2] + turn)
        beside = others[(others >= there[near].min()) & (others <= there[near].max())]
        nearest = int(beside[np.hypot(*(poses[beside] - pose)[:, :2].T).argmin()])
        joined.append((k, nearest, seen_from(pose, poses[nearest]).tolist()))
    return joined
