"""A map that lives: runs that ended well give places further looks, and a replay of other runs says whether it helps.

A place looks otherwise on another day. Where a run was sure of its place though the view spoke against it, its frame
becomes a further look of the keyframe: the same virtual views, warped from where the robot stood. What is seen is
compared with the best look of each place. A keyframe has `Settings.looks` at most; of more, the one goes without which
the views of these runs would lose least, never the taught one. So a map does not grow with the days.

The new map is taken only if runs that it has not learned from are no less probable under it (`compared`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np
from scipy.special import stdtrit

from smal.arrays import Float32s, Floats, Indices, Int8s
from smal.camera import STRAIGHT, Camera, Image, Scene
from smal.features import extract
from smal.features.extraction import in_parallel
from smal.files.packed import packed, unpacked
from smal.likelihood import evenly, over, scale
from smal.map import VisualMap
from smal.model import Model
from smal.movement import Atom, Movement, dead_reckoning, seen_from
from smal.planning import Planner
from smal.planning.config import PLANNER_CONFIG
from smal.robot import Localizer
from smal.teaching.calibration import CALIBRATION
from smal.teaching.demonstration import Demonstration, check_features, drives_to_goals
from smal.teaching.mapping import virtual_poses

#: By so much, natural logarithms, a new map may make a view less likely: a hundredth of what views tell.
_MAY_LOSE: Final = 0.05
#: A further look is warped from a frame that is nearer to its keyframe than this, in correlation lengths.
_LOOK_FROM: Final = 0.5


@dataclass(frozen=True, eq=False)
class Followed:
    """A run of f frames as a map follows it."""

    keyframes: Indices  # (f,) the likeliest one.
    offsets: Floats  # (f, 3) from there: ahead, left, turned left in radians.
    sure: Floats  # (f,) probability of being within a correlation length of there.
    says: Floats  # (f,) log ratio by which the view speaks for the place, if all of what was taught shows.
    #: (f,) logarithm of how much likelier the view was, after all before it, than a view of elsewhere.
    evidence: Floats
    arrived: int  # Frame at which a robot would have said that it had arrived; f if none.


@dataclass(frozen=True)
class Verdict:
    """Of two maps, by runs that neither has learned from."""

    stretches: int  # Of way, that were compared; none where no view surprised.
    gain: float  # Mean evidence of a frame under the new map less that under the old one.
    least: float  # Lower bound of the gain (95 %, one-sided); minus infinity of fewer than two stretches.
    false_goals: int  # Runs in which the new map alone says too early that it has arrived.

    @property
    def better(self) -> bool:
        """Whether the new map is to be taken."""
        return self.stretches > 0 and self.least > -_MAY_LOSE and not self.false_goals


def whole_runs(runs: Sequence[Demonstration]) -> list[Demonstration]:
    """Return the runs that ended at a goal and have images, their pieces put together."""
    return [run for _, run in drives_to_goals(runs)]


def follow(model: Model, run: Demonstration) -> Followed:
    """Follow a run, as a robot would have been that drove it; ValueError where its goal is none of the map's."""
    localizer = Localizer(model)
    taught = model.mapped
    planner = Planner(taught, run.goal)
    rows = []
    arrived = len(run.atoms)
    for frame, raw in enumerate(run.features):
        odometry = None if run.odometry is None else run.odometry[frame].tolist()
        belief = localizer.observe(raw, odometry, [Atom(run.atoms[frame - 1])] if frame else [])
        summary = belief.summary()
        planner.decide(summary)
        if planner.said:
            arrived = min(arrived, frame)
        key = int(summary.keyframes[0])
        pose = taught.key_poses[key]
        apart = np.hypot(*(taught.key_poses[summary.keyframes, :2] - pose[:2]).T)
        near = (taught.key_drives[summary.keyframes] == taught.key_drives[key]) & (
            apart < taught.correlation_length
        )
        components = taught.described(model.centering.apply(raw))
        z = over(np.array(belief.cosine), *scale(taught.sample @ components))
        sure = (1.0 - belief.lost) * float(summary.weights @ near)
        rows.append(
            (key, *summary.offsets[0], sure, float(taught.likelihood.of(z)), belief.evidence)
        )
    key, ahead, left, turned, sure, says, evidence = np.array(rows).T
    offsets = np.stack([ahead, left, turned], axis=1)
    return Followed(key.astype(np.intp), offsets, sure, says, evidence, arrived)


def taken_up(model: Model, runs: Iterable[Demonstration]) -> Model:
    """Return the model with further looks where views of runs surprised, at most one a keyframe; it may be the same.

    Runs of which nobody knows the camera give none.
    """
    nearest: dict[int, tuple[float, Demonstration, int, Floats]] = {}
    seen: dict[int, list[Float32s]] = {}
    taught = model.mapped
    usual = _usually_says(model.mapped)
    for run in runs:
        if run.camera is None:
            continue
        followed = follow(model, run)
        for frame in np.flatnonzero(followed.sure > PLANNER_CONFIG.arrived).tolist():
            key = int(followed.keyframes[frame])
            offset = followed.offsets[frame]
            seen.setdefault(key, []).append(
                taught.described(model.centering.apply(run.features[frame]))
            )
            off = taught.lengths(Movement(math.hypot(*offset[:2]), float(offset[2])))
            if followed.says[frame] < usual / 2.0 and off < nearest.get(key, (_LOOK_FROM,))[0]:
                nearest[key] = off, run, frame, offset
    if not nearest:
        return model
    looks = in_parallel(lambda key: _look(model, *nearest[key][1:]), sorted(nearest))
    views = np.concatenate([taught.views, np.stack(list(looks))])
    of = np.append(taught.looks, sorted(nearest))
    full = np.flatnonzero(np.bincount(of) == taught.config.looks).tolist()
    rows = [
        _least(views, np.append(key, len(taught.keyframes) + np.flatnonzero(of == key)), seen[key])
        for key in full
    ]
    grown = replace(
        taught,
        views=np.delete(views, rows, axis=0),
        looks=np.delete(of, np.array(rows, dtype=np.intp) - len(taught.keyframes)).astype(np.int32),
    )
    return replace(model, mapped=grown)


def _usually_says(taught: VisualMap) -> float:
    """Return the log ratio by which the view of a keyframe speaks for the one before it, the median."""
    some = np.flatnonzero(np.diff(taught.key_drives) == 0)
    some = some[evenly(some.size, CALIBRATION.most_frames)]
    views, after = (unpacked(taught.views[keys, 1, STRAIGHT]) for keys in (some, some + 1))
    z = [
        over(one @ other, *scale(taught.sample @ other))
        for one, other in zip(views, after, strict=True)
    ]
    return float(np.median(taught.likelihood.of(np.array(z))))


def _look(model: Model, run: Demonstration, frame: int, offset: Floats) -> Int8s:
    """Return the virtual views (3, turns, r) of a keyframe as a frame shows it that was taken beside it."""
    taught = model.mapped
    image = cast("Sequence[Image]", run.images)[frame]
    scene = Scene(cast("Camera", run.camera), *taught.scene[1:].tolist())
    steps = seen_from(np.array(virtual_poses(taught.aside)), offset).tolist()
    raw = np.stack([extract(scene.warp(image, *step), model.feature_settings) for step in steps])
    return packed(model.centering.apply(raw) @ taught.basis).reshape(taught.views.shape[1:])


def _least(views: Int8s, rows: Indices, seen: Sequence[Float32s]) -> int:
    """Return the row without which these views lose least, of several the oldest; the first, taught one stays."""
    cosines = np.einsum("lptr,fr->flpt", unpacked(views[rows]), np.stack(seen)).max(axis=(2, 3))
    lost = [
        float((cosines.max(axis=1) - np.delete(cosines, one, axis=1).max(axis=1)).sum())
        for one in range(1, len(rows))
    ]
    return int(rows[1 + int(np.argmin(lost))])


def compared(old: Model, new: Model, runs: Iterable[Demonstration]) -> Verdict:
    """Compare two maps by how likely they make the views of runs, stretch of way by stretch."""
    taught = old.mapped
    gains = []
    false_goals = 0
    for run in runs:
        before = follow(old, run)
        after = follow(new, run)
        poses = (
            dead_reckoning(run.atoms, taught.movements) if run.odometry is None else run.odometry
        )
        way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        parts = max(int(way / (taught.config.mended * taught.correlation_length)), 1)
        gains += [
            float(part.mean()) for part in np.array_split(after.evidence - before.evidence, parts)
        ]
        # Said where the way goes on for longer than twice the way within which a goal is near.
        too_early = [
            float(np.hypot(*(poses[min(one.arrived, len(poses) - 1), :2] - poses[-1, :2])))
            > 2.0 * PLANNER_CONFIG.goal_s * taught.speed
            for one in (before, after)
        ]
        false_goals += too_early == [False, True]
    count = len(gains)
    least = -math.inf
    if count > 1:
        least = float(
            np.mean(gains) - stdtrit(count - 1, 0.95) * np.std(gains, ddof=1) / math.sqrt(count)
        )
    return Verdict(count, float(np.mean(gains)), least, false_goals)


def lived(
    model: Model,
    runs: Sequence[Demonstration],
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> tuple[Model, Verdict]:
    """Learn from every second run (`whole_runs`), compare by the others, and return the model that is better.

    `progress` is called with how many runs were followed, and their number. ValueError where there are fewer than two,
    or their features or goals are not the model's.
    """
    if len(runs) < 2:
        raise ValueError(
            "it takes two runs or more that ended at the goal: one half teaches, the other half judges"
        )
    check_features(runs, model.feature_settings.size)
    numbers = iter(range(len(runs)))

    def each(some: Sequence[Demonstration]) -> Iterator[Demonstration]:
        for run in some:
            progress(next(numbers), len(runs))
            yield run

    new = taken_up(model, each(runs[::2]))
    if new is model:
        return model, Verdict(0, 0.0, 0.0, 0)
    verdict = compared(model, new, each(runs[1::2]))
    return (new if verdict.better else model), verdict
