"""What the filter knows of the taught ways: keyframes, their virtual views, and how alike views are.

A keyframe is a taught frame together with how its place looks from beside and turned (`smal.virtual_views`). Keyframes
are a fifth of the correlation length apart, the way over which views become half as alike as they can be, so that
between two of them a view hardly changes. Nothing here is in ticks: a robot that drives faster, or a camera with
another rate, has the same map.

Views are kept as their principal components, which is what makes thousands of them fit a decision's time.
"""

import math
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from smal.action_space import Atom
from smal.features import Centering, extract
from smal.likeness import correlation_length, likelihood, turns_undone
from smal.movement import Movement, atom_movements, dead_reckoning, turns_ahead
from smal.virtual_views import USUAL_FOCAL, Image, Maps, Scene, fit_scene, focal_of_curves, remapped, turn_of_views

#: What names of goals are: letters, digits, and what may stand between them.
GOAL_NAME = r"\w[\w .-]{0,63}"
#: Turns of the virtual views, degrees. Twenty taught pixels, the width of a cell of HOG, are about 5 degrees, within
#: which a view turned stays alike; beyond 40 hardly anything of the taught image is left.
TURNS_DEG = np.arange(-40.0, 41.0, 5.0)
#: Keyframes in a correlation length; a view that is one of them further is a new one.
VIEWS_A_LENGTH = 5
#: Keyframes are so much of the correlation length apart, or so many degrees.
_SPACING, _SPACING_DEG = 1.0 / VIEWS_A_LENGTH, 12.0
#: Virtual views are taken so much of the correlation length aside.
_ASIDE = 0.4
#: Principal components keep this share of what views are, and at most so many are kept: 5,000 taught frames, 1 km at
#: 2 m/s, then take 0.2 GB and a few hundredths of a second.
_KEPT, _MOST_COMPONENTS = 0.9, 400
#: Keyframes whose views are compared with all others at once, which bounds the memory.
_AT_ONCE = 32
#: Views from which components are computed.
_SAMPLE = 2500

#: What numbers of a map can be; kappa is bounded so that no likelihood overflows.
_LONGEST = 1e6
_NUMBERS: dict[str, Callable[[float], bool]] = {
    **dict.fromkeys(("aside", "correlation_length", "correlation_rad", "tick_s"), lambda one: 1e-6 <= one <= _LONGEST),
    **dict.fromkeys(("outlier_cosine", "alike_cosine"), lambda one: -1.1 <= one <= 1.1),
    "kappa": lambda one: 0.0 < one <= 300.0,
}


#: Axes of the arrays of a map.
_AXES = {
    "poses": 2, "drives": 1, "keyframes": 1, "basis": 2, "views": 4, "movements": 2, "scene": 1,
    "stitched": 2, "stitch_offsets": 2,
}  # fmt: skip
_WHOLE = ("drives", "keyframes", "stitched")


def _is_orthonormal(basis: NDArray[np.float32]) -> bool:
    # Huge numbers of a damaged file would only give a warning on the way to the same answer.
    return bool((np.abs(basis) <= 1.01).all()) and bool(np.abs(basis.T @ basis - np.eye(basis.shape[1])).max() < 0.01)


def _is_name(given: object) -> bool:
    return isinstance(given, str) and re.fullmatch(GOAL_NAME, given) is not None


def _are_names(given: object) -> bool:
    return isinstance(given, tuple) and bool(given) and all(isinstance(name, str) for name in given)


def _sound(array: object, axes: int, kind: str) -> bool:
    if not isinstance(array, np.ndarray):
        return False
    return array.ndim == axes and array.dtype.kind == kind and bool(np.isfinite(array).all())


@dataclass(frozen=True, eq=False)
class VisualMap:
    """Taught ways, and how they look.

    Poses are x, y and heading in radians in axes of their own for each drive, by its odometry; lengths are in metres,
    or in units of one forward atom where a drive has no odometry.

    Parameters
    ----------
    poses : float64 array (f, 3)
        Of every taught frame.
    drives : int32 array (f,)
        Which demonstration it is of, ascending.
    keyframes : int32 array (k,)
        Taught frames that are keyframes, ascending; the first and last frame of every drive are among them.
    basis : float32 array (m, r)
        Principal components of centred features.
    views : float32 array (k, 3, turns, r)
        Components of each keyframe's views: from `aside` to the right, from there, from the left; each turned by
        `TURNS_DEG`.
    aside : float
    correlation_length, correlation_rad : float
        Way ahead, and turn, after which the expected cosine of two views is half way down to that of unrelated ones.
    kappa : float
        Concentration of the cosines of views that show one place: 1 over their standard deviation. A view is e times
        less likely where its cosine is that much smaller.
    outlier_cosine : float
        Cosine that views of one place and of unrelated places are equally likely to have.
    alike_cosine : float
        Cosine that most views of one place exceed: their mean less one standard deviation.
    movements : float64 array (5, 2)
        What each atom does between two frames (`smal.movement.atom_movements`).
    tick_s : float
        Time between two taught frames.
    odometry : bool
        Whether poses are of odometry, or the usual movements of atoms added up.
    scene : float64 array (3,)
        `smal.virtual_views.Scene`, for people.
    goals : tuple of str
        Where each drive leads.
    names : tuple of tuples of str
        Demonstrations that each drive is made of, in order: several where frames between them were lost.
    stitched : int32 array (s, 2)
        Pairs of keyframes of different drives that show one place (`smal.stitches`), ascending.
    stitch_offsets : float64 array (s, 3)
        Of the first one as seen from the second one: ahead, left, turned left in radians.
    """

    poses: NDArray[np.float64]
    drives: NDArray[np.int32]
    keyframes: NDArray[np.int32]
    basis: NDArray[np.float32]
    views: NDArray[np.float32]
    aside: float
    correlation_length: float
    correlation_rad: float
    kappa: float
    outlier_cosine: float
    alike_cosine: float
    movements: NDArray[np.float64]
    tick_s: float
    odometry: bool
    scene: NDArray[np.float64]
    goals: tuple[str, ...]
    names: tuple[tuple[str, ...], ...]
    stitched: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 2), dtype=np.int32))
    stitch_offsets: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        # Files are checked here too: what passes must not fail, or give a belief that is no number, while driving.
        arrays: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in _AXES}
        kinds = {name: "i" if name in _WHOLE else "f" for name in _AXES}
        wrong = [name for name, array in arrays.items() if not _sound(array, _AXES[name], kinds[name])]
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        wrong += [name for name, one in numbers.items() if type(one) not in (int, float) or not _NUMBERS[name](one)]
        odometry: object = self.odometry
        wrong += [] if isinstance(odometry, bool) else ["odometry"]
        if not wrong:
            frames, count = len(self.poses), len(self.keyframes)
            ends = np.flatnonzero(np.diff(self.drives, prepend=-1, append=-1))
            fit = {
                "poses": self.poses.shape == (frames, 3) and bool((np.abs(self.poses) <= _LONGEST).all()),
                "drives": self.drives.shape == (frames,) and bool((np.diff(self.drives, prepend=0) >= 0).all()),
                "keyframes": count > 0
                and bool(((self.keyframes >= 0) & (self.keyframes < frames)).all())
                and bool((np.diff(self.keyframes, prepend=-1) > 0).all())
                and bool(np.isin([*ends[:-1], *(ends[1:] - 1)], self.keyframes).all()),
                "views": self.views.shape == (count, 3, TURNS_DEG.size, self.basis.shape[1]),
                "components": self.basis.shape[1] > 0 and _is_orthonormal(self.basis),
                "length of views": float(np.linalg.norm(self.views, axis=-1).max(initial=0.0)) < 1.01,
                "movements": self.movements.shape == (len(Atom), 2),
                "scene": self.scene.shape == (3,),
                "goals": len(self.goals) == int(self.drives.max(initial=-1)) + 1 and all(map(_is_name, self.goals)),
                "names": len(self.names) == len(self.goals) and all(map(_are_names, self.names)),
                "stitched": self.stitched.shape == (len(self.stitched), 2)
                and bool(((self.stitched >= 0) & (self.stitched < count)).all()),
                "stitch_offsets": self.stitch_offsets.shape == (len(self.stitched), 3)
                and bool((np.abs(self.stitch_offsets) <= _LONGEST).all()),
            }
            wrong = [name for name, fits in fit.items() if not fits]
        if wrong:
            raise ValueError(f"the parts of the visual map do not fit together: {', '.join(wrong)}")

    @cached_property
    def flat_views(self) -> NDArray[np.float32]:
        """Every view as a row, (k * 3 * turns, r)."""
        return np.ascontiguousarray(self.views.reshape(-1, self.views.shape[-1]))

    @cached_property
    def neighbour_cosines(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Cosines of views that lie beside each other: by turn (k, 3, turns - 1), and by place (k, 2, turns)."""
        unit = self.views / np.maximum(np.linalg.norm(self.views, axis=-1, keepdims=True), 1e-12)
        return (unit[:, :, 1:] * unit[:, :, :-1]).sum(axis=-1), (unit[:, 1:] * unit[:, :-1]).sum(axis=-1)

    @cached_property
    def unlike(self) -> NDArray[np.bool_]:
        """Which keyframes look unlike each other, however turned, (k, k)."""
        count, middle = len(self.keyframes), TURNS_DEG.size // 2
        turned = np.ascontiguousarray(self.views[:, 1]).reshape(-1, self.views.shape[-1])
        best = np.empty((count, count), dtype=np.float32)
        for first in range(0, count, _AT_ONCE):
            views = self.views[first : first + _AT_ONCE, 1, middle]
            best[:, first : first + _AT_ONCE] = (turned @ views.T).reshape(count, -1, len(views)).max(axis=1)
        unlike: NDArray[np.bool_] = np.maximum(best, best.T) < self.outlier_cosine
        np.fill_diagonal(unlike, False)
        return unlike

    def outlier_of(self, cosines: NDArray[np.float32]) -> float:
        """Return the cosine from which on a frame shows a place rather than none of the map.

        That is how alike it is to the places that look unlike the one that it is most alike to. So it adapts to what
        makes all cosines small: noise, darkness, another season; and a view that shows nothing says nothing. Where all
        places look alike it is `outlier_cosine`. It is at most `alike_cosine`: in a street of houses that look the
        same, fine details alone tell places apart, and other houses must not make a robot lost that is on the way.

        Parameters
        ----------
        cosines : float32 array (k, 3, turns)
            Of the frame with every view.
        """
        best = cosines.reshape(len(cosines), -1).max(axis=1)
        others = best[self.unlike[best.argmax()]]
        return min(float(others.max()), self.alike_cosine) if others.size else self.outlier_cosine

    @cached_property
    def key_poses(self) -> NDArray[np.float64]:
        """Poses of the keyframes, (k, 3)."""
        return self.poses[self.keyframes]

    @cached_property
    def key_range(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First and last keyframe of the drive of each keyframe, (k,) and (k,)."""
        of = self.drives[self.keyframes]
        return np.searchsorted(of, of, side="left"), np.searchsorted(of, of, side="right") - 1

    @cached_property
    def arc(self) -> NDArray[np.float64]:
        """Way driven until each frame, all drives one after the other, (f,)."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        return np.concatenate([[0.0], np.cumsum(np.where(np.diff(self.drives) == 0, steps, 0.0))])

    @cached_property
    def key_goals(self) -> NDArray[np.str_]:
        """Where the drive of each keyframe leads, (k,)."""
        return np.array(self.goals)[self.drives[self.keyframes]]

    @property
    def speed(self) -> float:
        """Nominal speed, a second; 0 if nobody drove ahead."""
        return float(self.movements[Atom.FORWARD, 0]) / self.tick_s

    def lengths(self, movement: Movement) -> float:
        """How much a movement changes the view, in correlation lengths."""
        return math.hypot(movement.ahead / self.correlation_length, movement.turn_rad / (2.0 * self.correlation_rad))

    def cosines(self, centred: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the cosine of a frame (m,) with every view, (k, 3, turns)."""
        found: NDArray[np.float32] = self.flat_views @ (centred @ self.basis)
        return found.reshape(self.views.shape[:3])

    def content(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return its numbers and its arrays, for a file."""
        each = {one.name: getattr(self, one.name) for one in fields(self)}
        arrays = {name: value for name, value in each.items() if isinstance(value, np.ndarray)}
        return {name: value for name, value in each.items() if name not in arrays}, arrays


@dataclass(frozen=True, eq=False)
class MappedDrive:
    """What the map needs of one demonstration.

    Parameters
    ----------
    images : sequence of uint8 arrays (height, width, 3)
    raw : float32 array (f, m)
        Raw features of every image.
    atoms : int8 array (f,)
    odometry : float64 array (f, 3), optional
        x, y and heading in radians by the wheels.
    goal : str
        Where it leads.
    names : tuple of str
        Demonstrations that it is made of, in order.
    focal : float, optional
        Focal length over the image's width, where it is known.
    ahead : float32 array (f,), optional
        How fast the robot went ahead in the atoms of turning, as a share of its speed straight on; on the spot if not
        given. It counts where there is no odometry.
    """

    images: Sequence[Image]
    raw: NDArray[np.float32]
    atoms: NDArray[np.int8]
    odometry: NDArray[np.float64] | None
    goal: str
    names: tuple[str, ...]
    focal: float | None = None
    ahead: NDArray[np.float32] | None = None


def learn_visual_map(
    taught: Sequence[MappedDrive],
    centering: Centering,
    tick_s: float,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> VisualMap:
    """Make the map of demonstrations.

    Parameters
    ----------
    taught : sequence of MappedDrive
        By one robot. If one is without odometry, all go by the usual movements of atoms: a forward atom is one unit
        long, and an atom of turning turns as far as the views say (`turn_of_views`), on the spot or ahead as well.
    centering : Centering
    tick_s : float
        Time between two frames.
    progress : callable
        Called with keyframes done and their number.
    """
    atoms, odometry = [one.atoms for one in taught], [one.odometry for one in taught]
    told = [one.focal for one in taught if one.focal is not None]
    focal = float(np.median(told)) if told else None
    every = ImageChain([one.images for one in taught])

    def describe(image: Image) -> NDArray[np.float32]:
        return centering.apply(extract(image, centering.settings))

    with_odometry = all(one is not None for one in odometry)
    if with_odometry:
        ways = [np.asarray(one, dtype=np.float64) for one in odometry if one is not None]
        movements = atom_movements(ways, atoms)
    else:
        focal = USUAL_FOCAL if focal is None else focal
        turn_rad = turn_of_views(every, atoms, focal, describe) or USUAL_TURN_RAD_S * tick_s
        movements = _unit_movements(turn_rad, _ahead_in_turns(taught))
        ways = [dead_reckoning(one, movements) for one in atoms]
    poses = np.concatenate(ways)
    drives = np.repeat(np.arange(len(ways), dtype=np.int32), [len(way) for way in ways])
    centred = np.concatenate([centering.apply(one.raw) for one in taught])
    undone = None
    if turns_ahead(movements):
        focal = focal_of_curves(every, poses, drives.astype(np.intp), describe) if focal is None else focal
        undone = turns_undone(every, centred, poses, drives, focal, describe)
    length, unrelated = correlation_length(centred, poses, drives, undone)
    if not centred.any():
        raise ValueError("all images of the demonstrations look the same")
    scene = fit_scene(every, poses, drives.astype(np.intp), length, describe, focal)
    keyframes = _choose_keyframes(poses, drives, length)
    views, basis = _make_views(every, keyframes, scene, _ASIDE * length, describe, progress)
    kappa, outlier_cosine, alike_cosine = likelihood(centred, poses, drives, (_SPACING * length, length), undone)
    return VisualMap(
        poses=poses,
        drives=drives,
        keyframes=keyframes,
        basis=basis,
        views=views,
        aside=_ASIDE * length,
        correlation_length=length,
        correlation_rad=_correlation_turn(views, unrelated),
        movements=movements,
        tick_s=tick_s,
        odometry=with_odometry,
        scene=np.array([scene.focal, scene.height, scene.distance]),
        goals=tuple(one.goal for one in taught),
        names=tuple(one.names for one in taught),
        kappa=kappa,
        outlier_cosine=outlier_cosine,
        alike_cosine=alike_cosine,
    )


class ImageChain(Sequence[Image]):
    """Sequences of images as one, none of which is read before it is asked for."""

    def __init__(self, parts: Sequence[Sequence[Image]]) -> None:
        self._parts = parts
        self._ends = np.cumsum([len(part) for part in parts])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 - a sequence is asked for numbers or slices
        part = int(np.searchsorted(self._ends, index, side="right"))
        return self._parts[part][int(index) - (int(self._ends[part - 1]) if part else 0)]


#: How fast robots turn, where no drive turns and nothing else tells.
USUAL_TURN_RAD_S = math.radians(45.0)


def _unit_movements(turn_rad: float, ahead: float) -> NDArray[np.float64]:
    """Return the movements of atoms, (5, 2), in units of a forward one; turns go ahead by so many of them."""
    return np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [ahead, turn_rad], [ahead, -turn_rad]])


def _ahead_in_turns(taught: Sequence[MappedDrive]) -> float:
    """Return how fast the robot usually goes ahead in turning, as a share of its speed straight on."""
    told = [one.ahead[(one.atoms == Atom.LEFT) | (one.atoms == Atom.RIGHT)] for one in taught if one.ahead is not None]
    return float(np.median(np.concatenate(told))) if any(map(len, told)) else 0.0


def _correlation_turn(views: NDArray[np.float32], unrelated: float) -> float:
    """Measure the turn after which a view is half as alike as it can be, radians: at least the step of the views."""
    middle = TURNS_DEG.size // 2
    mean = np.einsum("kr,ktr->t", views[:, 1, middle], views[:, 1]) / len(views)
    mean = (mean[middle:] + mean[middle::-1]) / 2.0
    half = (float(mean[0]) + unrelated) / 2.0
    turn_deg = float(np.interp(-half, -np.minimum.accumulate(mean), TURNS_DEG[middle:]))
    return math.radians(max(turn_deg, float(TURNS_DEG[1] - TURNS_DEG[0])))


def _choose_keyframes(poses: NDArray[np.float64], drives: NDArray[np.int32], length: float) -> NDArray[np.int32]:
    chosen: list[int] = []
    for frame in range(len(poses)):
        first = frame == 0 or drives[frame] != drives[frame - 1]
        last = frame == len(poses) - 1 or drives[frame] != drives[frame + 1]
        if not (first or last):
            moved = poses[frame] - poses[chosen[-1]]
            far = math.hypot(moved[0], moved[1]) >= _SPACING * length
            if not far and abs(math.remainder(moved[2], math.tau)) < math.radians(_SPACING_DEG):
                continue
        chosen.append(frame)
    return np.array(chosen, dtype=np.int32)


def _make_views(
    images: Sequence[Image],
    keyframes: NDArray[np.int32],
    scene: Scene,
    aside: float,
    describe: Callable[[Image], NDArray[np.float32]],
    progress: Callable[[int, int], None],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Make the virtual views of keyframes, and the components in which they are kept."""
    lefts = (-aside, 0.0, aside)

    # Drives may be of cameras of different sizes.
    @cache
    def maps_of(shape: tuple[int, ...]) -> list[list[Maps]]:
        return [[scene.maps(shape, 0.0, left, math.radians(turn)) for turn in TURNS_DEG] for left in lefts]

    def views_of(frame: int) -> NDArray[np.float32]:
        image = images[frame]
        return np.stack([np.stack([describe(remapped(image, one)) for one in row]) for row in maps_of(image.shape[:2])])

    # All views at once would take gigabytes for a long drive: components first, from a sample of keyframes.
    with ThreadPoolExecutor() as pool:
        each = len(lefts) * TURNS_DEG.size
        sample = keyframes[np.unique(np.linspace(0, keyframes.size - 1, max(1, _SAMPLE // each)).astype(int))].tolist()
        made = dict(zip(sample, pool.map(views_of, sample), strict=True))
        basis = _components(np.concatenate(list(made.values())).reshape(-1, len(describe(images[0]))))

        def kept(frame: int) -> NDArray[np.float32]:
            return (made[frame] if frame in made else views_of(frame)) @ basis

        views = []
        for done, view in enumerate(pool.map(kept, keyframes.tolist()), 1):
            views.append(view)
            progress(done, keyframes.size)
    return np.stack(views), basis


def _components(sample: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the leading principal components of rows (s, m), (m, r)."""
    products = sample @ sample.T
    # All components take three times as long.
    values, vectors = eigh(products, subset_by_index=[max(0, len(sample) - _MOST_COMPONENTS), len(sample) - 1])
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = np.cumsum(values) / max(float(np.trace(products)), 1e-12)
    count = min(int(np.searchsorted(share, _KEPT)) + 1, int((values > 1e-6 * values[0]).sum()))
    basis = sample.T @ vectors[:, :count]
    unit: NDArray[np.float32] = (basis / np.linalg.norm(basis, axis=0)).astype(np.float32)
    return unit
