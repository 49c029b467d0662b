"""Stitches: places that taught drives share, and the offset of one drive from the other.

The paper shares states between demonstrations with similar sequences of frames (Algorithm 1). We share keyframes. Two
keyframes of different drives show the same place if each is the most likely view of the other, more alike than
unrelated places, and their neighbours match in order for a whole correlation length. The best virtual view gives the
offset of one keyframe from the other. With the odometry, the offsets of all pairs around a place are averaged.

Two corners of a town can look alike for longer than that. Therefore the odometry must agree: the longest stretch that
two drives share gives the transformation between their axes. Every other shared stretch must be consistent with it,
within the accuracy of the odometry.
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

#: A keyframe, a keyframe of another drive, and the pose of the first relative to the second: ahead, left, turned.
_Stitch = tuple[int, int, list[float]]


def stitched(visual_map: VisualMap) -> VisualMap:
    """Return the map with the stitches between its drives."""
    if visual_map.drive_count == 1:
        return visual_map
    found: list[_Stitch] = []
    best, offsets = _best_of_each_drive(visual_map)
    for one, other in permutations(range(visual_map.drive_count), 2):
        matched = best[:, other]
        # Poses of the keyframes of one drive in the axes of the other.
        robot = placed(offsets[:, other], visual_map.key_poses[matched])
        stretches = _stretches(visual_map, best, one, other)
        kept = _reachable(visual_map, stretches, matched, robot)
        if kept:
            found.extend(_joined(visual_map, np.concatenate(kept), matched, robot))
    found.sort(key=lambda stitch: stitch[:2])
    pairs = [stitch[:2] for stitch in found]
    poses = [stitch[2] for stitch in found]
    return replace(
        visual_map,
        stitched=np.array(pairs, dtype=np.int32).reshape(-1, 2),
        stitch_offsets=np.array(poses, dtype=np.float64).reshape(-1, 3),
    )


def _best_of_each_drive(visual_map: VisualMap) -> tuple[Indices, Floats]:
    """Return for each keyframe the most likely keyframe of each drive (k, d), -1 without any, and its own offset."""
    count = len(visual_map.keyframes)
    drives = visual_map.drive_count
    best = np.full((count, drives), -1, dtype=np.intp)
    offsets = np.zeros((count, drives, 3))

    def compare(start: int) -> None:
        own = unpacked(visual_map.views[start : start + BATCH, 1, STRAIGHT])
        likely = [visual_map.likely(view)[0] for view in own]
        candidates = np.unique(np.concatenate(likely))
        views = unpacked(visual_map.views[candidates])
        cosines = (views.reshape(-1, own.shape[1]) @ own.T).reshape(*views.shape[:3], -1)
        for number, view in enumerate(own):
            found = _best_views(visual_map, view, candidates, cosines[..., number])
            for drive, (keyframe, offset) in found.items():
                best[start + number, drive] = keyframe
                offsets[start + number, drive] = offset

    for _ in in_parallel(compare, range(0, count, BATCH)):
        pass
    return best, offsets


def _best_views(
    visual_map: VisualMap,
    view: Float32s,
    candidates: Indices,
    cosines: Float32s,
) -> dict[int, tuple[int, tuple[float, float, float]]]:
    """Return for each drive the candidate most like a view, and the offset of the view from it.

    `cosines` (n, 3, turns) compare the view (r,) with all views of the candidates (n,).
    """
    sample = visual_map.sample @ view
    drives = visual_map.key_drives[candidates]
    found = {}
    for drive in np.unique(drives).tolist():
        of_drive = np.flatnonzero(drives == drive)
        alike = cosines[of_drive]
        k, p, t = map(int, np.unravel_index(alike.argmax(), alike.shape))
        z = standing_out(alike[k, p, t], sample)
        if visual_map.likelihood.mixed(ANY_DAY, z, 1.0) > 1.0:
            left = (_peak(alike[k, :, t], p) - 1.0) * visual_map.aside
            turned = math.radians((_peak(alike[k, p], t) - STRAIGHT) * STEP_DEG)
            found[drive] = int(candidates[of_drive[k]]), (0.0, left, turned)
    return found


def _peak(values: Float32s, at: int) -> float:
    """Return the index of the maximum of the parabola through the largest value and its neighbours."""
    middle = min(max(at, 1), values.size - 2)
    before, here, after = values[middle - 1 : middle + 2].tolist()
    curve = before - 2.0 * here + after
    if curve >= 0.0:
        return float(at)
    vertex = middle + 0.5 * (before - after) / curve
    return float(min(max(vertex, 0.0), values.size - 1.0))


def _stretches(visual_map: VisualMap, best: Indices, one: int, other: int) -> list[Indices]:
    """Return stretches of one drive that match another drive mutually and in order for a correlation length."""
    keys = np.flatnonzero(visual_map.key_drives == one)
    matched = best[keys, other]
    back = np.where(matched >= 0, best[matched, one], -1)
    advance = visual_map.config.advance
    mutual = (back >= 0) & (np.abs(back - keys) <= advance)
    step = np.diff(matched)
    goes_on = mutual[:-1] & mutual[1:] & (step >= 0) & (step <= advance)
    stretches = np.split(keys, np.flatnonzero(~goes_on) + 1)
    return [each for each in stretches if each.size > visual_map.config.views_a_length]


def _reachable(
    visual_map: VisualMap, stretches: list[Indices], there: Indices, robot: Floats
) -> list[Indices]:
    """Return the stretches that are consistent with the longest by the odometry of both drives."""
    kept: list[Indices] = []
    for stretch in sorted(stretches, key=len, reverse=True):
        pairs = [
            (known, new)
            for other in kept
            for known in (other[0], other[-1])
            for new in (stretch[0], stretch[-1])
        ]
        apart = [_off(visual_map, there, robot, *pair) for pair in pairs]
        # The nearest stretch counts: it has the least drift.
        if not apart or min(apart)[1] < visual_map.config.trusted:
            kept.append(stretch)
    return kept


def _off(
    visual_map: VisualMap, there: Indices, robot: Floats, one: int, other: int
) -> tuple[float, float]:
    """Return the way between two stitches, and the disagreement of the drives in standard deviations of odometry."""
    noise = BY_ODOMETRY if visual_map.odometry else BY_ATOMS
    poses = visual_map.key_poses
    length = visual_map.correlation_length
    by_one = seen_from(poses[other], poses[one])
    by_other = seen_from(robot[other], robot[one])
    off = by_other[:2] - by_one[:2]
    turned = float(wrapped(by_other[2:] - by_one[2:])[0])
    way = 0.0
    variance = 0.0
    for first, last in (sorted((one, other)), sorted((there[one], there[other]))):
        steps = np.diff(poses[first : last + 1], axis=0)
        way += float(np.hypot(*steps[:, :2].T).sum())
        turns = wrapped(steps[:, 2])
        variance += noise.turn**2 * float(np.abs(turns).sum())
        variance += (noise.pace * float(turns.sum())) ** 2
    # A stitch is as exact as the spacing of virtual views in turn, and as the correlation length along the way.
    drift = math.radians(noise.drift_deg) ** 2 * way / length
    heading = math.sqrt(drift + variance + math.radians(STEP_DEG) ** 2)
    aside = heading * float(np.hypot(*by_one[:2]))
    distance = math.hypot(noise.pace * way, aside, length)
    return way, max(float(np.hypot(*off)) / distance, abs(turned) / heading)


def _joined(visual_map: VisualMap, here: Indices, there: Indices, robot: Floats) -> list[_Stitch]:
    """Return stitches for all keyframes of a shared stretch, by averaging the found stitches.

    The transformation between the axes is averaged over a correlation length before and after each keyframe. With
    individual stitches, the way jumps from one keyframe to the next, and the robot turns to and fro.
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
        # A rigid transformation, by the position of the keyframe under each stitch.
        origin = np.array([*poses[k, :2], 0.0])
        rotation = np.array([0.0, 0.0, turn])
        moved = placed(seen_from(poses[near], origin), rotation)
        position = np.mean(robot[near, :2] - moved[:, :2], axis=0)
        pose = np.append(position, poses[k, 2] + turn)
        matched = there[near]
        beside = others[(others >= matched.min()) & (others <= matched.max())]
        distance = np.hypot(*(poses[beside] - pose)[:, :2].T)
        nearest = int(beside[distance.argmin()])
        joined.append((k, nearest, seen_from(pose, poses[nearest]).tolist()))
    return joined
