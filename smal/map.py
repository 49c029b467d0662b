"""The map: taught ways, their keyframes, and the views from beside and turned at each keyframe.

A keyframe is a taught frame with virtual views of its place from beside and turned (`smal.camera.Scene`). Keyframes are
a fifth of the correlation length apart, so that a view hardly changes between two of them. The correlation length is
the way after which the mean cosine of two views is half way to the cosine of unrelated views. No length is in ticks:
the map is independent of the speed and of the frame rate. Views are stored as principal components, so that thousands
of them fit into the time of a decision. `smal.teaching.mapping` builds the map from drives.
"""

import math
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from smal.arrays import AnyArray, Float32s, Floats, Indices, Int8s, Int32s, evenly
from smal.camera import STEP_DEG, STRAIGHT, TURNS_DEG, Scene
from smal.files.packed import BATCH, unit, unpacked
from smal.files.stored import Content
from smal.keyframes import MAP_CONFIG, MapConfig, without_detours
from smal.likelihood import GRID, SHARES, Likelihood, standing_out
from smal.movement import Atom, Movement, placed, seen_from

_T = TypeVar("_T", bound=np.floating[Any])
GOAL_NAME = r"\w[\w .-]{0,63}"  # Letters, digits, and separators within.
_LONGEST = 1e6  # Maximum magnitude of the numbers in a map.
_MOST_KEYFRAMES = 400_000  # 300 km of usual views.
_NUMBERS: dict[str, Callable[[float], bool]] = {
    **dict.fromkeys(
        ("correlation_length", "correlation_rad", "tick_s"),
        lambda number: 1e-6 <= number <= _LONGEST,
    ),
    "gamma": lambda number: 0.0 < number <= 1e3,
    "next_correlation": lambda number: 0.0 < number < 1.0,
}
#: Number of axes of the arrays.
_AXES = {
    "poses": 2, "drives": 1, "keyframes": 1, "basis": 2, "views": 4, "blank": 1, "movements": 2,
    "log_ratio": 2, "stitched": 2, "stitch_offsets": 2, "variants": 1,
}  # fmt: skip
_WHOLE = ("drives", "keyframes", "views", "stitched", "variants")


@dataclass(frozen=True, eq=False)
class VisualMap:
    """Taught ways and their views: f frames, of which k are keyframes.

    Poses are x, y and heading in radians, in axes of their own for each drive, by its odometry. Lengths are in metres,
    or in forward atoms if a drive has no odometry.
    """

    #: (f, 3) pose of every taught frame.
    poses: Floats
    #: (f,) drive of each frame, ascending.
    drives: Int32s
    #: (k,) frames, ascending; they include the first and the last frame of every drive.
    keyframes: Int32s
    #: (m, r) components of centred features.
    basis: Float32s
    #: (k + e, 3, turns, r) components of each keyframe's views, of any length (`packed`): from `aside` to the right,
    #: from the keyframe, from the left; each turned by `TURNS_DEG`. View variants follow the taught views.
    views: Int8s
    #: (r,) components of a blank picture, of unit length.
    blank: Float32s
    #: Way ahead, and turn, after which the mean cosine of two views is half way to the cosine of unrelated views.
    correlation_length: float
    correlation_rad: float
    #: Likelihood of views, with gamma (`smal.likelihood.Likelihood`).
    log_ratio: Floats
    gamma: float
    #: Correlation of the views of neighbouring keyframes, 0 to 1.
    next_correlation: float
    #: (5, 2) movement of each atom between frames (`smal.teaching.movements`).
    movements: Floats
    #: Time between two taught frames.
    tick_s: float
    #: Whether poses come from odometry; otherwise they are the integrated movements of atoms.
    odometry: bool
    #: Camera of the taught images, its height, and the distance of the scene.
    taught_scene: Scene
    #: Goal of each drive.
    goals: tuple[str, ...]
    #: Demonstrations of each drive: several if frames between them were lost.
    names: tuple[tuple[str, ...], ...]
    #: Width and height of the first taught image, pixels.
    size: tuple[int, int]
    #: (s, 2) pairs of keyframes of different drives at the same place (`smal.teaching.stitches`), ascending.
    stitched: Int32s = field(default_factory=lambda: np.empty((0, 2), dtype=np.int32))
    #: (s, 3) pose of the first keyframe relative to the second: ahead, left, turned left in radians.
    stitch_offsets: Floats = field(default_factory=lambda: np.empty((0, 3)))
    #: (e,) keyframe of each view variant (`smal.teaching.map_update`), the oldest first.
    variants: Int32s = field(default_factory=lambda: np.empty(0, dtype=np.int32))

    config: MapConfig = MAP_CONFIG

    def __post_init__(self) -> None:
        """Raise ValueError if the parts do not fit together, so that a damaged map fails on loading."""
        wrong = _unsound(self) or [name for name, fits in _fit(self).items() if not fits]
        if wrong:
            raise ValueError(f"the parts of the visual map do not fit together: {', '.join(wrong)}")

    def content(self) -> Content:
        """Return the metadata and the arrays of the model file."""
        values = {part.name: getattr(self, part.name) for part in fields(self)}
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        numbers = {name: value for name, value in values.items() if name not in arrays}
        parts = {"config": asdict(self.config), "taught_scene": asdict(self.taught_scene)}
        return numbers | parts, arrays

    @classmethod
    def of_content(cls, numbers: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Build the map from the content of a file; errors are as in `Stored.of_content`."""
        goals = numbers["goals"]
        names = numbers["names"]
        size = numbers["size"]
        lists = [goals, names]
        if isinstance(names, list):
            lists += names
        if not all(isinstance(part, list) for part in lists):
            raise TypeError(
                "the goals of the map must be a list, and the names of its drives lists"
            )
        if not isinstance(size, list):
            raise TypeError("the size of the taught images must be a list")
        if not isinstance(numbers["config"], dict):
            raise TypeError(
                f"the config of the map must be a mapping, got {numbers['config']!r:.40}"
            )
        if lacks := {part.name for part in fields(MapConfig)} - numbers["config"].keys():
            raise ValueError(f"the config of the map lacks {', '.join(sorted(lacks))}")
        converted = {
            "goals": tuple(goals),
            "names": tuple(map(tuple, names)),
            "size": tuple(size),
            "taught_scene": Scene.of_content(numbers["taught_scene"]),
            "config": MapConfig(**numbers["config"]),
        }
        return cls(**arrays | numbers | converted)

    @cached_property
    def neighbour_cosines(self) -> tuple[Float32s, Float32s]:
        """Cosines of neighbouring views: by turn (k + e, 3, turns - 1), and by place (k + e, 2, turns)."""
        count, places, turns, _ = self.views.shape
        by_turn = np.empty((count, places, turns - 1), dtype=np.float32)
        by_place = np.empty((count, places - 1, turns), dtype=np.float32)
        for first in range(0, count, BATCH):
            batch = slice(first, first + BATCH)
            views = unpacked(self.views[batch])
            by_turn[batch] = (views[:, :, 1:] * views[:, :, :-1]).sum(axis=-1)
            by_place[batch] = (views[:, 1:] * views[:, :-1]).sum(axis=-1)
        return by_turn, by_place

    @cached_property
    def further(self) -> list[Indices]:
        """Rows of `views` of each keyframe's second view variant, its third and so on, (k,) each; -1 if missing."""
        rows: list[Indices] = []
        rank = np.zeros(len(self.keyframes), dtype=np.intp)
        for row, key in enumerate(self.variants.tolist(), len(self.keyframes)):
            if rank[key] == len(rows):
                rows.append(np.full(len(self.keyframes), -1))
            rows[rank[key]][key] = row
            rank[key] += 1
        return rows

    def best_variant(self, keyframes: Indices, score: Callable[..., NDArray[_T]]) -> NDArray[_T]:
        """Return the best score of each keyframe (n,) over its view variants, (n, ...).

        Parameters
        ----------
        keyframes : array (n,)
        score : callable
            Takes a subset of the n (a slice or indices) and its rows of `views`; returns the scores of the subset.
        """
        best = score(slice(None), keyframes)
        for rows in self.further:
            subset = np.flatnonzero(rows[keyframes] >= 0)
            if subset.size:
                scores = score(subset, rows[keyframes[subset]])
                best[subset] = np.maximum(best[subset], scores)
        return best

    def ahead_cosines(self, components: Float32s, keyframes: Indices) -> Float32s:
        """Return the cosines of a frame (r,) with the views from keyframes (n,) themselves, (n, turns).

        The best view variant of each keyframe counts.
        """
        middle = np.full(TURNS_DEG.size, 1)
        turns = np.arange(TURNS_DEG.size)
        return self.best_variant(
            keyframes, lambda _, rows: self.cosines(components, rows[:, None], middle, turns)
        )

    @cached_property
    def reference(self) -> Indices:
        """Keyframes whose own views are the sample of elsewhere, evenly spread."""
        return evenly(len(self.keyframes), self.config.reference)

    @cached_property
    def sample(self) -> Float32s:
        """Views of the sample of elsewhere, (reference, r)."""
        return unpacked(self.views[self.reference, 1, STRAIGHT])

    @cached_property
    def overview(self) -> Float32s:
        """Every fifth keyframe at every second turn, in the leading components: (k / 5, turns / 2, leading).

        Views change slowly along the way and with the turn. The overview selects keyframes for a closer comparison.
        """
        rows, _ = self._middles
        middle = self.views[rows, 1, STRAIGHT % 2 :: 2]
        leading = unpacked(middle)[..., : self.config.leading]
        return np.ascontiguousarray(leading)

    @cached_property
    def _middles(self) -> tuple[Indices, Indices]:
        """Rows of `views` in the overview, and the index of the fifth keyframe that each row shows."""
        step = self.config.views_a_length
        first = self.config.views_a_length // 2
        keys = np.append(np.arange(len(self.keyframes)), self.variants).astype(np.intp)
        rows = np.flatnonzero(keys % step == first)
        return rows, keys[rows] // step

    @cached_property
    def _repeats_rad(self) -> float:
        """Turn after which z values at other places correlate by 1 / e, measured on virtual views.

        Without different places, views repeat until they no longer overlap.
        """
        keys = self.reference
        poses = self.key_poses[keys]
        drives = self.key_drives[keys]
        apart = np.hypot(*np.moveaxis(poses[:, None, :2] - poses[:, :2], -1, 0))
        far = apart > self.config.elsewhere * self.correlation_length
        far |= drives[:, None] != drives
        z = []
        for turn in (STRAIGHT, -1):
            views = unpacked(self.views[keys, 1, turn])
            z.append(
                np.stack([standing_out(views @ view, self.sample @ view) for view in views])[far]
            )
        if far.sum() < 3 or min(np.ptp(values) for values in z) == 0.0:
            return self.field_rad / 2.0
        correlation = float(np.clip(np.corrcoef(z)[0, 1], 0.01, 0.99))
        return -math.radians(float(TURNS_DEG[-1])) / math.log(correlation)

    @cached_property
    def likelihood(self) -> Likelihood:
        """Likelihood of views at places."""
        return Likelihood(self.log_ratio, self.gamma)

    @cached_property
    def key_poses(self) -> Floats:
        """Poses of the keyframes, (k, 3)."""
        return self.poses[self.keyframes]

    @cached_property
    def key_drives(self) -> Int32s:
        """Drive of each keyframe, (k,)."""
        return self.drives[self.keyframes]

    @cached_property
    def key_range(self) -> tuple[Indices, Indices]:
        """First and last keyframe of the drive of each keyframe, (k,) and (k,)."""
        drives = self.key_drives
        first = np.searchsorted(drives, drives, side="left")
        end = np.searchsorted(drives, drives, side="right")
        return first, end - 1

    @cached_property
    def arc(self) -> Floats:
        """Way until each frame, over all drives in a row, without detours, (f,)."""
        on = without_detours(self.poses, self.drives, self.correlation_length, self.config)
        steps = np.hypot(*np.diff(self.poses[on, :2], axis=0).T)
        same_drive = np.diff(self.drives[on]) == 0
        way = np.append(0.0, np.cumsum(np.where(same_drive, steps, 0.0)))
        return np.asarray(way[np.cumsum(on) - 1])

    @cached_property
    def key_goals(self) -> NDArray[np.str_]:
        """Goal of the drive of each keyframe, (k,)."""
        return np.array(self.goals)[self.key_drives]

    @property
    def drive_count(self) -> int:
        """Number of drives."""
        return len(self.goals)

    @cached_property
    def frames(self) -> Indices:
        """Number of frames of each drive, (d,)."""
        return np.bincount(self.drives)

    def chosen_goal(self, goal: str | None) -> str:
        """Return the goal, or the only goal of the map; ValueError if it is not found or ambiguous."""
        known = sorted(set(self.goals))
        if goal is None and len(known) > 1:
            raise ValueError(f"the model has the goals {', '.join(known)}; name one of them")
        if goal is not None and goal not in known:
            raise ValueError(f"the model has no goal {goal!r}; it has {', '.join(known)}")
        return known[0] if goal is None else goal

    def frames_along(self, keyframes: Indices | int, way: Floats) -> Indices:
        """Return the frames on the drives of keyframes at a `way` (`arc`), at most to their ends."""
        first, last = (self.keyframes[edge[keyframes]] for edge in self.key_range)
        # Frames of other drives, in other axes, come before and after.
        return np.clip(np.searchsorted(self.arc, way), first, last)

    @property
    def aside(self) -> float:
        """Distance of the views from aside to the keyframe, in the map's unit."""
        return self.config.aside * self.correlation_length

    @property
    def scene(self) -> Floats:
        """Field of view in degrees, height of the camera, and distance of the scene, (3,)."""
        scene = self.taught_scene
        return np.array([scene.camera.field_deg, scene.height, scene.distance])

    @property
    def field_rad(self) -> float:
        """Horizontal field of view of the taught images, radians."""
        return math.radians(self.taught_scene.camera.field_deg)

    @property
    def speed(self) -> float:
        """Nominal speed, in the map's unit a second; 0 if no drive goes ahead."""
        return float(self.movements[Atom.FORWARD, 0]) / self.tick_s

    @property
    def turn_rad(self) -> float:
        """Turn in a taught tick, radians; the usual turn if no drive turns."""
        taught = abs(float(self.movements[Atom.LEFT, 1]))
        return taught or math.radians(self.config.usual_turn_deg_s) * self.tick_s

    @property
    def apart_rad(self) -> float:
        """Turn between two different views; at least the turn between two virtual views."""
        return max(self.correlation_rad, math.radians(STEP_DEG))

    def lengths(self, movement: Movement) -> float:
        """Return the change of the view by a movement, in correlation lengths."""
        way = movement.ahead / self.correlation_length
        return math.hypot(way, movement.turn_rad / (2.0 * self.apart_rad))

    def expected(self, step: Floats) -> float:
        """Return the expected correlation of two views that are a step (ahead, left, turned) apart, 0 to 1."""
        way = self.config.views_a_length * math.hypot(step[0], step[1]) / self.correlation_length
        turn = abs(math.remainder(step[2], math.tau)) / self.correlation_rad
        by_way = way * math.log(self.next_correlation)
        by_turn = turn * self.gamma * math.log(2.0)
        return math.exp(-math.hypot(by_way, by_turn))

    def repeated(self, turn_rad: float) -> float:
        """Return the correlation of the z values at other places before and after a turn, 0 to 1.

        A turn changes views fast. But the same scene moves through them, and what resembles a place in it remains.
        """
        return math.exp(-abs(math.remainder(turn_rad, math.tau)) / self._repeats_rad)

    def described(self, centred: Float32s) -> Float32s:
        """Return the components of a frame (m,), of unit length, or zero for a blank frame, (r,)."""
        return unit(centred @ self.basis)

    def cosines(
        self,
        components: Float32s,
        keyframes: Indices,
        places: Indices,
        turns: Indices,
    ) -> Float32s:
        """Return the cosines of a frame's components (r,) with views, in the broadcast shape of the indices.

        Rows of `views` beyond the keyframes are view variants.
        """
        indices = np.broadcast_arrays(keyframes, places, turns)
        views = np.ravel_multi_index(indices, self.views.shape[:3])
        unique, inverse = np.unique(views, return_inverse=True)
        rows = self.views.reshape(-1, components.size)[unique].astype(np.float32)
        lengths = np.sqrt(np.einsum("vr,vr->v", rows, rows))
        found: Float32s = rows @ components / np.maximum(lengths, 1.0)
        return found[inverse].reshape(views.shape)

    def likely(self, components: Float32s) -> tuple[Indices, Floats]:
        """Return the keyframes to compare with a frame (r,), and how many keyframes each represents, (n,) and (n,).

        On a short way these are all keyframes. On a longer way they are the keyframes where the overview is most
        similar, and the sample of elsewhere.
        """
        count = len(self.keyframes)
        step = self.config.views_a_length
        if count <= self.config.looked_at:
            return np.arange(count), np.ones(count)
        _, middle = self._middles
        cosines = self.overview @ components[: self.config.leading]
        alike = np.full(middle.max() + 1, -np.inf, dtype=np.float32)
        np.maximum.at(alike, middle, cosines.max(axis=1))
        most = self.config.looked_at // step
        best = np.argpartition(-alike, most - 1)[:most]
        near = (best[:, None] * step + np.arange(step)).ravel()
        near = near[near < count]
        others = np.setdiff1d(self.reference, near)
        share = (count - near.size) / max(others.size, 1)
        stand_for = np.append(np.ones(near.size), np.full(others.size, share))
        return np.append(near, others), stand_for


def in_common_axes(visual_map: VisualMap) -> Floats:
    """Return the keyframes' poses (k, 3), with drives that share a place in the axes of the first of them."""
    poses = visual_map.key_poses.copy()
    drives = visual_map.key_drives
    ones, others = visual_map.stitched.T
    known = np.zeros(visual_map.drive_count, dtype=bool)
    for first in range(visual_map.drive_count):
        if known[first]:
            continue
        known[first] = True
        # Drives are moved one at a time, by a place shared with a known drive.
        while (ready := np.flatnonzero(~known[drives[ones]] & known[drives[others]])).size:
            stitch = ready[0]
            one = ones[stitch]
            joined = drives == drives[one]
            target = placed(visual_map.stitch_offsets[stitch], poses[others[stitch]])
            poses[joined] = placed(seen_from(poses[joined], poses[one]), target)
            known[drives[one]] = True
    return poses


def way_from(mapped: VisualMap, keyframe: int, offset: Floats, along: Floats) -> Floats:
    """Return places (s, 2) of a keyframe's drive, ahead and left of a robot at an offset from that keyframe.

    They are at distances `along` (s,) from the point where the drive passes the robot, and end with the drive.
    """
    key = mapped.keyframes[keyframe]
    target = mapped.frames_along(keyframe, mapped.arc[key] + offset[0] + along)
    from_keyframe = seen_from(mapped.poses[target], mapped.poses[key])
    return seen_from(from_keyframe, offset)[:, :2]


def beside(mapped: VisualMap, keyframe: int, count: int) -> Indices:
    """Return the keyframes of the same drive at most `count` keyframes away, the keyframe included."""
    first, last = (int(edge[keyframe]) for edge in mapped.key_range)
    return np.arange(max(first, keyframe - count), min(last, keyframe + count) + 1)


def _unsound(mapped: VisualMap) -> list[str]:
    """Return the names of parts that are invalid by themselves."""
    wrong = []
    for name, axes in _AXES.items():
        kind = "i" if name in _WHOLE else "f"
        if not _sound(getattr(mapped, name), axes, kind):
            wrong.append(name)
    for name, fits in _NUMBERS.items():
        number = getattr(mapped, name)
        if type(number) not in (int, float) or not fits(number):
            wrong.append(name)
    odometry: object = mapped.odometry
    return wrong if isinstance(odometry, bool) else [*wrong, "odometry"]


def _fit(mapped: VisualMap) -> dict[str, bool]:
    return _ways_fit(mapped) | _views_fit(mapped) | _names_fit(mapped) | _stitches_fit(mapped)


def _ways_fit(mapped: VisualMap) -> dict[str, bool]:
    frames = len(mapped.poses)
    keys = mapped.keyframes
    drive_steps = np.diff(mapped.drives, prepend=0)
    starts = np.flatnonzero(np.diff(mapped.drives, prepend=-1, append=-1))
    ends = [*starts[:-1], *(starts[1:] - 1)]
    ascending = bool((np.diff(keys, prepend=-1) > 0).all())
    return {
        "poses": mapped.poses.shape == (frames, 3) and _moderate(mapped.poses),
        "drives": mapped.drives.shape == (frames,) and bool(np.isin(drive_steps, (0, 1)).all()),
        "keyframes": 0 < len(keys) <= _MOST_KEYFRAMES and _within(keys, frames) and ascending,
        "ends of drives": bool(np.isin(ends, keys).all()),
        "movements": mapped.movements.shape == (len(Atom), 2) and _moderate(mapped.movements),
        "size": _is_size(mapped.size),
    }


def _views_fit(mapped: VisualMap) -> dict[str, bool]:
    components = mapped.basis.shape[1]
    variants = mapped.variants
    count = len(mapped.keyframes) + len(variants)
    shape = (count, 3, TURNS_DEG.size, components)
    table = (SHARES.size, GRID.size)
    small = bool((np.abs(mapped.log_ratio) < 100.0).all())
    unit_length = float(np.linalg.norm(mapped.blank)) < 1.01
    return {
        "views": mapped.views.dtype == np.int8 and mapped.views.shape == shape,
        "blank": mapped.blank.shape == (components,) and unit_length,
        "components": 0 < components <= len(mapped.basis) and _moderate(mapped.basis),
        "log_ratio": mapped.log_ratio.shape == table and small,
        "variants": _within(variants, len(mapped.keyframes))
        and bool((np.bincount(variants) < mapped.config.most_variants).all()),
    }


def _names_fit(mapped: VisualMap) -> dict[str, bool]:
    drives = int(mapped.drives.max(initial=-1)) + 1
    texts = all(type(name) is str for name in mapped.goals)
    return {
        "goals": len(mapped.goals) == drives
        and texts
        and all(re.fullmatch(GOAL_NAME, name) for name in mapped.goals),
        "names": len(mapped.names) == len(mapped.goals)
        and all(parts and {*map(type, parts)} == {str} for parts in mapped.names),
    }


def _stitches_fit(mapped: VisualMap) -> dict[str, bool]:
    stitched = mapped.stitched
    offsets = mapped.stitch_offsets
    count = len(stitched)
    distinct = len(np.unique(stitched, axis=0)) == count
    return {
        "stitched": stitched.shape == (count, 2)
        and _within(stitched, len(mapped.keyframes))
        and distinct,
        "stitch_offsets": offsets.shape == (count, 3) and _moderate(offsets),
    }


def _moderate(numbers: AnyArray) -> bool:
    return bool((np.abs(numbers) <= _LONGEST).all())


def _is_size(size: tuple[object, ...]) -> bool:
    return len(size) == 2 and all(type(side) is int and 0 < side <= _LONGEST for side in size)


def _within(numbers: AnyArray, count: int) -> bool:
    return bool(((numbers >= 0) & (numbers < count)).all())


def _sound(array: object, axes: int, kind: str) -> bool:
    if not isinstance(array, np.ndarray):
        return False
    precise = array.dtype.kind == kind and (kind == "i" or array.dtype.itemsize >= 4)
    return array.ndim == axes and precise and bool(np.isfinite(array).all())
