"""Map update: successful runs add view variants to places, if a replay of other runs confirms an improvement.

A place looks different on another day. If a run was certain of its place although the view contradicted it, its frame
becomes a view variant of the keyframe: the same virtual views, warped from the robot's pose. Views are compared with
the best variant of each place. A keyframe has at most `MapConfig.most_variants`. Beyond that number, the map removes
the variant with the least loss for the views of these runs, never the taught one. So the size of the map is bounded.

The new map is accepted only if runs that were not used for learning are at least as likely under it (`compared`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, cast

import numpy as np
from scipy.special import stdtrit

from smal.arrays import Bools, Float32s, Floats, Indices, Int8s
from smal.camera import Camera, Image
from smal.features import extract
from smal.features.extraction import in_parallel, looked_at
from smal.features.resizing import fitted
from smal.files.packed import packed, unpacked
from smal.likelihood import over, scale
from smal.map import VisualMap
from smal.model import Model
from smal.movement import Atom, Movement, dead_reckoning, seen_from
from smal.planning import Planner
from smal.planning.config import PLANNER_CONFIG
from smal.robot import Localizer
from smal.teaching.demonstration import Demonstration, check_features
from smal.teaching.mapping import virtual_poses

#: Accepted loss of log likelihood of a view under a new map: a hundredth of the information of views.
_MAY_LOSE: Final = 0.05
#: Maximum distance of the frame of a view variant from its keyframe, in correlation lengths.
_VARIANT_FROM: Final = 0.5


@dataclass(frozen=True, eq=False)
class LocalisedRun:
    """A run of f frames, as localised on a map."""

    #: (f,) the most likely keyframe.
    keyframes: Indices
    #: (f, 3) offset from it: ahead, left, turned left in radians.
    offsets: Floats
    #: (f,) probability of being within a correlation length of it.
    sure: Floats
    #: (f,) log likelihood ratio of the view at the place, if all of what was taught is visible.
    log_ratio: Floats
    #: (f,) log likelihood ratio of the view, given all views before, to a view of elsewhere.
    evidence: Floats
    #: Frame of the announced arrival; f without any.
    arrived: int


@dataclass(frozen=True)
class Verdict:
    """Comparison of two maps on runs that were used for neither."""

    #: Number of compared stretches of way; 0 without any new view variant.
    stretches: int
    #: Mean evidence of a frame under the new map, less under the old map.
    gain: float
    #: Lower bound of the gain (95 %, one-sided); minus infinity for fewer than two stretches.
    least: float
    #: Runs in which only the new map announces the arrival too early.
    false_goals: int

    @property
    def better(self) -> bool:
        """Whether the new map is accepted."""
        return self.stretches > 0 and self.least > -_MAY_LOSE and not self.false_goals


def localise(model: Model, run: Demonstration) -> LocalisedRun:
    """Localise a recorded run; ValueError if the map does not have its goal."""
    localizer = Localizer(model)
    taught = model.mapped
    planner = Planner(taught, run.goal)
    rows = []
    arrived = len(run.atoms)
    for frame, raw in enumerate(run.features):
        odometry = None if run.odometry is None else run.odometry[frame].tolist()
        executed = [Atom(run.atoms[frame - 1])] if frame else []
        belief = localizer.observe(raw, odometry, executed)
        summary = belief.summary()
        planner.decide(summary)
        if planner.said:
            arrived = min(arrived, frame)
        key = int(summary.keyframes[0])
        components = taught.described(model.centering.apply(raw))
        z = over(np.array(belief.cosine), *scale(taught.sample @ components))
        sure = (1.0 - belief.lost) * summary.share(_near(taught, key))
        of_view = float(taught.likelihood.of(z))
        rows.append((key, *summary.offsets[0], sure, of_view, belief.evidence))
    key, ahead, left, turned, sure, log_ratio, evidence = np.array(rows).T
    offsets = np.stack([ahead, left, turned], axis=1)
    return LocalisedRun(key.astype(np.intp), offsets, sure, log_ratio, evidence, arrived)


def _near(taught: VisualMap, key: int) -> Bools:
    """Return which keyframes (k,) are within a correlation length of a keyframe on its drive."""
    apart = taught.key_poses[:, :2] - taught.key_poses[key, :2]
    same_drive = taught.key_drives == taught.key_drives[key]
    near: Bools = same_drive & (np.hypot(*apart.T) < taught.correlation_length)
    return near


def with_view_variants(model: Model, runs: Iterable[Demonstration]) -> Model:
    """Return the model with new view variants from unexpected views of runs, at most one a keyframe.

    A view is unexpected if it is evidence against the certain place where it was seen. Without such
    views it is the same model. Runs without a camera are ignored.
    """
    nearest: dict[int, tuple[float, Demonstration, int, Floats]] = {}
    views_of: dict[int, list[Float32s]] = {}
    taught = model.mapped
    for run in runs:
        if run.camera is None:
            continue
        localised = localise(model, run)
        for frame in np.flatnonzero(localised.sure > PLANNER_CONFIG.arrived).tolist():
            key = int(localised.keyframes[frame])
            offset = localised.offsets[frame]
            view = taught.described(model.centering.apply(run.features[frame]))
            views_of.setdefault(key, []).append(view)
            off = taught.lengths(Movement(math.hypot(*offset[:2]), float(offset[2])))
            nearest_off = nearest[key][0] if key in nearest else _VARIANT_FROM
            if localised.log_ratio[frame] < 0.0 and off < nearest_off:
                nearest[key] = off, run, frame, offset
    if not nearest:
        return model
    variants = in_parallel(lambda key: _variant(model, *nearest[key][1:]), sorted(nearest))
    views = np.concatenate([taught.views, np.stack(list(variants))])
    keys = np.append(taught.variants, sorted(nearest))
    first = len(taught.keyframes)
    rows = []
    for key in np.flatnonzero(np.bincount(keys) == taught.config.most_variants).tolist():
        of_key = np.append(key, first + np.flatnonzero(keys == key))
        rows.append(_least(views, of_key, views_of[key]))
    kept = np.delete(keys, np.array(rows, dtype=np.intp) - first)
    grown = replace(taught, views=np.delete(views, rows, axis=0), variants=kept.astype(np.int32))
    return replace(model, mapped=grown)


def _variant(model: Model, run: Demonstration, frame: int, offset: Floats) -> Int8s:
    """Return the virtual views (3, turns, r) of a keyframe, warped from a frame beside it."""
    taught = model.mapped
    image = cast("Sequence[Image]", run.images)[frame]
    scene = replace(taught.taught_scene, camera=cast("Camera", run.camera))
    steps = seen_from(np.array(virtual_poses(taught.aside)), offset).tolist()
    image = looked_at(image, model.feature_settings)
    shape = fitted(image.shape, model.feature_settings.pixels)
    views = (scene.warp(image, step, shape) for step in steps)
    raw = np.stack([extract(view, model.feature_settings) for view in views])
    components = model.centering.apply(raw) @ taught.basis
    return packed(components).reshape(taught.views.shape[1:])


def _least(views: Int8s, rows: Indices, seen: Sequence[Float32s]) -> int:
    """Return the row with the least loss for these views, the oldest of equal ones; the first, taught row stays."""
    cosines = np.einsum("lptr,fr->flpt", unpacked(views[rows]), np.stack(seen)).max(axis=(2, 3))
    best = cosines.max(axis=1)
    losses = []
    for row in range(1, len(rows)):
        without = np.delete(cosines, row, axis=1).max(axis=1)
        losses.append(float((best - without).sum()))
    return int(rows[1 + int(np.argmin(losses))])


def compared(old: Model, new: Model, runs: Iterable[Demonstration]) -> Verdict:
    """Compare two maps by the likelihood of the views of runs, stretch by stretch."""
    taught = old.mapped
    gains = []
    false_goals = 0
    for run in runs:
        before = localise(old, run)
        after = localise(new, run)
        poses = run.odometry
        if poses is None:
            poses = dead_reckoning(run.atoms, taught.movements)
        way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        parts = max(int(way / (taught.config.mended * taught.correlation_length)), 1)
        stretches = np.array_split(after.evidence - before.evidence, parts)
        gains += [float(stretch.mean()) for stretch in stretches]
        # Too early: the way goes on for longer than the usual distance of "found".
        most = PLANNER_CONFIG.found_s * taught.speed
        too_early = [_from_end(poses, localised.arrived) > most for localised in (before, after)]
        false_goals += too_early == [False, True]
    count = len(gains)
    mean = float(np.mean(gains))
    least = -math.inf
    if count > 1:
        margin = stdtrit(count - 1, 0.95) * np.std(gains, ddof=1) / math.sqrt(count)
        least = float(mean - margin)
    return Verdict(count, mean, least, false_goals)


def _from_end(poses: Floats, frame: int) -> float:
    """Return the distance of a frame from the end of a run."""
    apart = poses[min(frame, len(poses) - 1), :2] - poses[-1, :2]
    return float(np.hypot(*apart))


def update_map(
    model: Model,
    runs: Sequence[Demonstration],
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> tuple[Model, Verdict]:
    """Learn from every second run (`Drive.whole`), compare on the others, and return the better model.

    Parameters
    ----------
    model : Model
    runs : sequence of Demonstration
    progress : callable
        Called with the number of finished runs, and the total.

    Raises
    ------
    ValueError
        If there are fewer than two runs, or their features or goals are not those of the model.
    """
    if len(runs) < 2:
        raise ValueError(
            f"too few runs that ended at a goal ({len(runs)} < minimum 2): one half of the runs "
            "teaches, the other half confirms; record more runs"
        )
    check_features(runs, model.feature_settings.size)
    numbers = iter(range(len(runs)))

    def counted(part: Sequence[Demonstration]) -> Iterator[Demonstration]:
        for run in part:
            progress(next(numbers), len(runs))
            yield run

    new = with_view_variants(model, counted(runs[::2]))
    if new is model:
        return model, Verdict(0, 0.0, 0.0, 0)
    verdict = compared(model, new, counted(runs[1::2]))
    return (new if verdict.better else model), verdict
