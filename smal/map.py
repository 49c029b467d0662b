"""The map: taught ways, their keyframes, and how each keyframe looks from beside and turned.

A keyframe is a taught frame together with how its place looks from beside and turned (`smal.camera.Scene`). Keyframes
are a fifth of the correlation length apart, the way over which views become half as alike as they can be, so that
between two of them a view hardly changes. No length here is in ticks: a robot that drives faster, or a camera with
another rate, has the same map. Views are kept as their principal components, so that thousands of them fit a decision's
time. `smal.teaching.mapping` makes the map of drives.
"""

import math
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from smal.camera import STEP_DEG, STRAIGHT, TURNS_DEG
from smal.files.packed import BATCH, unit, unpacked
from smal.files.stored import Content
from smal.keyframes import MAP_CONFIG, MapConfig, leads_on
from smal.likelihood import GRID, SHARES, Likelihood, evenly
from smal.movement import Atom, Movement, placed, seen_from

_T = TypeVar("_T", bound=np.floating[Any])
GOAL_NAME = r"\w[\w .-]{0,63}"  # Letters, digits, and what may stand between them.
_LONGEST = 1e6  # What numbers of a map can be.
_MOST_KEYFRAMES = 400_000  # Keyframes: 300 km of usual views.
_NUMBERS: dict[str, Callable[[float], bool]] = {
    **dict.fromkeys(
        ("aside", "correlation_length", "correlation_rad", "tick_s"),
        lambda one: 1e-6 <= one <= _LONGEST,
    ),
    "gamma": lambda one: 0.0 < one <= 1e3,
    "next_correlation": lambda one: 0.0 < one < 1.0,
}
#: Axes of its arrays.
_AXES = {
    "poses": 2, "drives": 1, "keyframes": 1, "basis": 2, "views": 4, "blank": 1, "movements": 2, "scene": 1,
    "log_ratio": 2, "stitched": 2, "stitch_offsets": 2, "looks": 1,
}  # fmt: skip
_WHOLE = ("drives", "keyframes", "views", "stitched", "looks")


@dataclass(frozen=True, eq=False)
class VisualMap:
    """Taught ways, and how they look: f frames, of which k are keyframes.

    Poses are x, y and heading in radians in axes of their own for each drive, by its odometry; lengths are in metres,
    or in units of one forward atom where a drive has no odometry.
    """

    poses: NDArray[np.float64]  # (f, 3) of every taught frame.
    drives: NDArray[np.int32]  # (f,) which demonstration it is of, ascending.
    keyframes: NDArray[
        np.int32
    ]  # (k,) frames, ascending; the first and last of every drive are among them.
    basis: NDArray[np.float32]  # (m, r) components of centred features.
    #: (k + e, 3, turns, r) components of each keyframe's views, of any length (`packed`): from `aside` to the right,
    #: from there, from the left; each turned by `TURNS_DEG`. After the taught ones come further looks.
    views: NDArray[np.int8]
    blank: NDArray[np.float32]  # (r,) components of a picture that shows nothing, of unit length.
    aside: float  # How far the views from aside are from the keyframe, in the map's unit.
    #: Way ahead, and turn, after which the mean cosine of two views is half way down to that of unrelated ones.
    correlation_length: float
    correlation_rad: float
    log_ratio: NDArray[
        np.float64
    ]  # With gamma what views say of places, see `smal.likelihood.Likelihood`.
    gamma: float
    next_correlation: float  # How far the views of a keyframe and the next say the same, 0 to 1.
    movements: NDArray[
        np.float64
    ]  # (5, 2) what each atom does between frames (`smal.teaching.movements`).
    tick_s: float  # Time between two taught frames.
    odometry: bool  # Whether poses are of odometry, or the usual movements of atoms added up.
    scene: NDArray[
        np.float64
    ]  # Field of view in degrees, height of the camera, distance of what it sees.
    goals: tuple[str, ...]  # Where each drive leads.
    names: tuple[
        tuple[str, ...], ...
    ]  # Demonstrations of each drive: several where frames between them were lost.
    size: tuple[int, int]  # Width and height of the first taught image, pixels.
    #: (s, 2) pairs of keyframes of different drives that show one place (`smal.teaching.stitches`), ascending; and of
    #: the first as seen from the second, (s, 3): ahead, left, turned left in radians.
    stitched: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 2), dtype=np.int32))
    stitch_offsets: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    #: (e,) keyframe of each further look (`smal.teaching.living`), the oldest first.
    looks: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, dtype=np.int32))

    config: MapConfig = MAP_CONFIG  # The numbers that shaped it.

    def __post_init__(self) -> None:
        """ValueError where parts do not fit together: a map cannot fail, or give a belief that is no number, later."""
        wrong = _unsound(self) or [name for name, fits in _fit(self).items() if not fits]
        if wrong:
            raise ValueError(f"the parts of the visual map do not fit together: {', '.join(wrong)}")

    def content(self) -> Content:
        """Return what the file says of the map, and the arrays in it."""
        each = {part.name: getattr(self, part.name) for part in fields(self)}
        arrays = {name: value for name, value in each.items() if isinstance(value, np.ndarray)}
        numbers = {name: value for name, value in each.items() if name not in arrays}
        return numbers | {"config": asdict(self.config)}, arrays

    @classmethod
    def of_content(cls, numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """Make it of what a file says; errors as of `Stored.of_content`."""
        goals = numbers["goals"]
        names = numbers["names"]
        size = numbers["size"]
        if not (
            isinstance(goals, list)
            and isinstance(names, list)
            and all(isinstance(each, list) for each in names)
        ):
            raise TypeError(
                "the goals of the map must be a list, and the names of its drives lists"
            )
        if not isinstance(size, list):
            raise TypeError("the size of the taught images must be a list")
        told = {
            "goals": tuple(goals),
            "names": tuple(map(tuple, names)),
            "size": tuple(size),
            "config": MapConfig(**numbers["config"]),
        }
        return cls(**arrays | numbers | told)

    @cached_property
    def neighbour_cosines(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cosines of views beside each other: by turn (k + e, 3, turns - 1), and by place (k + e, 2, turns)."""
        count, places, turns, _ = self.views.shape
        by_turn = np.empty((count, places, turns - 1), dtype=np.float32)
        by_place = np.empty((count, places - 1, turns), dtype=np.float32)
        for first in range(0, count, BATCH):
            some = slice(first, first + BATCH)
            views = unpacked(self.views[some])
            by_turn[some] = (views[:, :, 1:] * views[:, :, :-1]).sum(axis=-1)
            by_place[some] = (views[:, 1:] * views[:, :-1]).sum(axis=-1)
        return by_turn, by_place

    @cached_property
    def further(self) -> list[NDArray[np.intp]]:
        """Rows of `views` of each keyframe's second look, its third and so on, (k,) each; -1 where it has none."""
        rows: list[NDArray[np.intp]] = []
        rank = np.zeros(len(self.keyframes), dtype=np.intp)
        for row, key in enumerate(self.looks.tolist(), len(self.keyframes)):
            if rank[key] == len(rows):
                rows.append(np.full(len(self.keyframes), -1))
            rows[rank[key]][key] = row
            rank[key] += 1
        return rows

    def best_look(
        self, keyframes: NDArray[np.intp], say: Callable[..., NDArray[_T]]
    ) -> NDArray[_T]:
        """Return what is said of keyframes (n,) by their best look, (n, ...).

        `say` gives it of some of the n, by a slice or their numbers, with those rows of `views`.
        """
        found = say(slice(None), keyframes)
        for rows in self.further:
            some = np.flatnonzero(rows[keyframes] >= 0)
            if some.size:
                found[some] = np.maximum(found[some], say(some, rows[keyframes[some]]))
        return found

    @cached_property
    def reference(self) -> NDArray[np.intp]:
        """Keyframes whose own views are the sample of elsewhere: evenly spread, so many whatever the map's size."""
        return evenly(len(self.keyframes), self.config.reference)

    @cached_property
    def sample(self) -> NDArray[np.float32]:
        """Views that say what elsewhere looks like, (reference, r)."""
        return unpacked(self.views[self.reference, 1, STRAIGHT])

    @cached_property
    def overview(self) -> NDArray[np.float32]:
        """Every fifth keyframe from every second turn, in the leading components: (k / 5, turns / 2, leading).

        Views change slowly along the way, and slowly with the turn: where these are alike is where to look closely.
        """
        middle = self.views[self._middles[0], 1, STRAIGHT % 2 :: 2]
        return np.ascontiguousarray(unpacked(middle)[..., : self.config.leading])

    @cached_property
    def _middles(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of `views` in the overview, and which fifth keyframe each is a look of."""
        step = self.config.views_a_length
        first = self.config.views_a_length // 2
        of = np.append(np.arange(len(self.keyframes)), self.looks).astype(np.intp)
        rows = np.flatnonzero(of % step == first)
        return rows, of[rows] // step

    @cached_property
    def likelihood(self) -> Likelihood:
        """What views say of places."""
        return Likelihood(self.log_ratio, self.gamma)

    @cached_property
    def key_poses(self) -> NDArray[np.float64]:
        """Poses of the keyframes, (k, 3)."""
        return self.poses[self.keyframes]

    @cached_property
    def key_drives(self) -> NDArray[np.int32]:
        """Drive of each keyframe, (k,)."""
        return self.drives[self.keyframes]

    @cached_property
    def key_range(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First and last keyframe of the drive of each keyframe, (k,) and (k,)."""
        of = self.key_drives
        return np.searchsorted(of, of, side="left"), np.searchsorted(of, of, side="right") - 1

    @cached_property
    def arc(self) -> NDArray[np.float64]:
        """Way to drive until each frame, all drives one after the other, (f,): without what led nowhere."""
        on = leads_on(self.poses, self.drives, self.correlation_length, self.config)
        steps = np.hypot(*np.diff(self.poses[on, :2], axis=0).T)
        way = np.concatenate(
            [[0.0], np.cumsum(np.where(np.diff(self.drives[on]) == 0, steps, 0.0))]
        )
        return np.asarray(way[np.cumsum(on) - 1])

    @cached_property
    def key_goals(self) -> NDArray[np.str_]:
        """Where the drive of each keyframe leads, (k,)."""
        return np.array(self.goals)[self.key_drives]

    @cached_property
    def frames(self) -> NDArray[np.intp]:
        """Frames of each drive, (d,)."""
        return np.bincount(self.drives)

    @property
    def speed(self) -> float:
        """Nominal speed, in the map's unit a second; 0 if nobody drove ahead."""
        return float(self.movements[Atom.FORWARD, 0]) / self.tick_s

    @property
    def turn_rad(self) -> float:
        """Turn in a taught tick, radians; where none of its drives turned, that of usual robots."""
        return (
            abs(float(self.movements[Atom.LEFT, 1]))
            or math.radians(self.config.usual_turn_deg_s) * self.tick_s
        )

    @property
    def apart_rad(self) -> float:
        """Turn by which two poses see another view: that between two virtual views at least."""
        return max(self.correlation_rad, math.radians(STEP_DEG))

    def lengths(self, movement: Movement) -> float:
        """How much a movement changes the view, in correlation lengths."""
        return math.hypot(
            movement.ahead / self.correlation_length, movement.turn_rad / (2.0 * self.apart_rad)
        )

    def expected(self, step: NDArray[np.float64]) -> float:
        """Return how far two views that are a step (ahead, left, turned) apart should say the same, 0 to 1."""
        way = self.config.views_a_length * math.hypot(step[0], step[1]) / self.correlation_length
        turn = abs(math.remainder(step[2], math.tau)) / self.correlation_rad
        return math.exp(
            -math.hypot(way * math.log(self.next_correlation), turn * self.gamma * math.log(2.0))
        )

    def described(self, centred: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the components of a frame (m,), of unit length, or zero where it shows nothing, (r,)."""
        return unit(centred @ self.basis)

    def cosines(
        self,
        components: NDArray[np.float32],
        keyframes: NDArray[np.intp],
        places: NDArray[np.intp],
        turns: NDArray[np.intp],
    ) -> NDArray[np.float32]:
        """Return the cosines of a frame's components (r,) with some views, in the shape of their indices together.

        Rows of `views` that are no keyframes are further looks.
        """
        views = np.ravel_multi_index(
            np.broadcast_arrays(keyframes, places, turns), self.views.shape[:3]
        )
        each, where = np.unique(views, return_inverse=True)
        rows = self.views.reshape(-1, components.size)[each].astype(np.float32)
        lengths = np.sqrt(np.einsum("vr,vr->v", rows, rows))
        found: NDArray[np.float32] = rows @ components / np.maximum(lengths, 1.0)
        return found[where].reshape(views.shape)

    def likely(
        self, components: NDArray[np.float32]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the keyframes to look at for a frame (r,), and how many keyframes each stands for, (n,) and (n,).

        Of a short way these are all; of a longer one those about where the overview is most alike, and the sample of
        elsewhere.
        """
        count = len(self.keyframes)
        step = self.config.views_a_length
        if count <= self.config.looked_at:
            return np.arange(count), np.ones(count)
        _, middle = self._middles
        alike = np.full(middle.max() + 1, -np.inf, dtype=np.float32)
        np.maximum.at(
            alike, middle, (self.overview @ components[: self.config.leading]).max(axis=1)
        )
        best = np.argpartition(-alike, self.config.looked_at // step)[
            : self.config.looked_at // step
        ]
        near = (best[:, None] * step + np.arange(step)).ravel()
        near = near[near < count]
        others = np.setdiff1d(self.reference, near)
        shares = np.full(others.size, (count - near.size) / max(others.size, 1))
        return np.append(near, others), np.append(np.ones(near.size), shares)


def in_common_axes(visual_map: VisualMap) -> NDArray[np.float64]:
    """Return the keyframes' poses (k, 3): of drives that share a place in axes of the first, of others in their own."""
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


def way_from(
    mapped: VisualMap, keyframe: int, offset: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return places (s, 2) of a keyframe's drive, ahead and left of a robot at an offset from that keyframe.

    They are so far `along` (s,) the drive from where it passes the robot; none lies beyond its end.
    """
    key = mapped.keyframes[keyframe]
    first, end = (
        np.searchsorted(mapped.drives, mapped.drives[key], side) for side in ("left", "right")
    )
    target = np.clip(
        np.searchsorted(mapped.arc, mapped.arc[key] + offset[0] + along), first, end - 1
    )
    return seen_from(seen_from(mapped.poses[target], mapped.poses[key]), offset)[:, :2]


def beside(mapped: VisualMap, keyframe: int, count: int) -> NDArray[np.intp]:
    """Return the keyframes of the same drive that are at most so many from one, itself among them."""
    first, last = (int(one[keyframe]) for one in mapped.key_range)
    return np.arange(max(first, keyframe - count), min(last, keyframe + count) + 1)


def _unsound(one: VisualMap) -> list[str]:
    """Name the parts that are not what they should be, whatever the others are."""
    wrong = [
        name
        for name, axes in _AXES.items()
        if not _sound(getattr(one, name), axes, "fi"[name in _WHOLE])
    ]
    for name, fits in _NUMBERS.items():
        number = getattr(one, name)
        if type(number) not in (int, float) or not fits(number):
            wrong.append(name)
    odometry: object = one.odometry
    return wrong if isinstance(odometry, bool) else [*wrong, "odometry"]


def _fit(one: VisualMap) -> dict[str, bool]:
    return _ways_fit(one) | _views_fit(one) | _names_fit(one) | _stitches_fit(one)


def _ways_fit(one: VisualMap) -> dict[str, bool]:
    frames = len(one.poses)
    ends = np.flatnonzero(np.diff(one.drives, prepend=-1, append=-1))
    keys = one.keyframes
    return {
        "poses": one.poses.shape == (frames, 3) and _moderate(one.poses),
        "drives": one.drives.shape == (frames,)
        and bool(np.isin(np.diff(one.drives, prepend=0), (0, 1)).all()),
        "keyframes": 0 < len(keys) <= _MOST_KEYFRAMES
        and _within(keys, frames)
        and bool((np.diff(keys, prepend=-1) > 0).all()),
        "ends of drives": bool(np.isin([*ends[:-1], *(ends[1:] - 1)], keys).all()),
        "movements": one.movements.shape == (len(Atom), 2) and _moderate(one.movements),
        "scene": one.scene.shape == (3,) and _moderate(one.scene),
        "size": _is_size(one.size),
    }


def _views_fit(one: VisualMap) -> dict[str, bool]:
    components = one.basis.shape[1]
    count = len(one.keyframes) + len(one.looks)
    return {
        "views": one.views.dtype == np.int8
        and one.views.shape == (count, 3, TURNS_DEG.size, components),
        "blank": one.blank.shape == (components,) and float(np.linalg.norm(one.blank)) < 1.01,
        "components": 0 < components <= len(one.basis) and _moderate(one.basis),
        "log_ratio": one.log_ratio.shape == (SHARES.size, GRID.size)
        and bool((np.abs(one.log_ratio) < 100.0).all()),
        "looks": _within(one.looks, len(one.keyframes))
        and bool((np.bincount(one.looks) < one.config.looks).all()),
    }


def _names_fit(one: VisualMap) -> dict[str, bool]:
    return {
        "goals": len(one.goals) == int(one.drives.max(initial=-1)) + 1
        and {*map(type, one.goals)} <= {str}
        and all(re.fullmatch(GOAL_NAME, name) for name in one.goals),
        "names": len(one.names) == len(one.goals)
        and all(parts and {*map(type, parts)} == {str} for parts in one.names),
    }


def _stitches_fit(one: VisualMap) -> dict[str, bool]:
    joined = len(one.stitched)
    return {
        "stitched": one.stitched.shape == (joined, 2)
        and _within(one.stitched, len(one.keyframes))
        and len(np.unique(one.stitched, axis=0)) == joined,
        "stitch_offsets": one.stitch_offsets.shape == (joined, 3) and _moderate(one.stitch_offsets),
    }


def _moderate(numbers: NDArray[Any]) -> bool:
    return bool((np.abs(numbers) <= _LONGEST).all())


def _is_size(size: tuple[object, ...]) -> bool:
    return len(size) == 2 and all(type(side) is int and 0 < side <= _LONGEST for side in size)


def _within(numbers: NDArray[Any], count: int) -> bool:
    return bool(((numbers >= 0) & (numbers < count)).all())


def _sound(array: object, axes: int, kind: str) -> bool:
    if not isinstance(array, np.ndarray):
        return False
    kinds = array.dtype.kind == kind and (kind == "i" or array.dtype.itemsize >= 4)
    return array.ndim == axes and kinds and bool(np.isfinite(array).all())
