"""Demonstrations: drives with camera images, executed movements, and odometry."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import call
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from smal.arrays import AnyArray, Float32s, Floats, Int8s
from smal.camera import Camera, Image
from smal.features.extraction import Parallel, extract, in_parallel, looked_at
from smal.features.settings import FeatureSettings
from smal.map import GOAL_NAME
from smal.target.learning import Box

#: Goal of drives without a goal.
USUAL_GOAL = "victim"

#: Computes an array.
Task = Callable[[], Any]
_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A drive of a person or the expert, or a part of it: f frames.

    A drive with lost frames has several parts, in the order of time.

    Raises
    ------
    ValueError
        If lengths differ, or numbers are out of range. The error contains the name.
    """

    #: Name of its episode.
    name: str
    #: (f, m) raw features (`smal.features.extract`), without dropped frames; rows can be computed on access.
    features: Float32s | Sequence[Float32s]
    #: (f,) `Atom` k was executed between frames k and k + 1, the last one after the last frame.
    atoms: Int8s
    #: Whether it ended at the goal.
    successful: bool = True
    #: Whether it started off the route, to show the way back.
    recovery: bool = False
    #: RGB images, read on access. The map is built from them.
    images: Sequence[Image] | None = None
    #: (f, 3) odometry: x, y and heading in radians.
    odometry: Floats | None = None
    #: Drive of this part; its name if empty.
    episode: str = ""
    goal: str = USUAL_GOAL
    #: Estimated from the images by default.
    camera: Camera | None = None
    #: (f,) speed ahead during turning atoms, -1 to 1 times the speed straight on, for a car; by default 0.
    ahead: Float32s | None = None
    #: Drawn position of the goal in the last image: left, top, right, bottom, as shares of its size.
    box: Box | None = None
    #: Ticks that were lost between the part before and this part.
    lost: int = 0

    def __post_init__(self) -> None:
        shape = getattr(self.features, "shape", (len(self.features), None))
        frames = len(self.atoms)
        if len(shape) != 2 or self.atoms.shape != shape[:1]:
            self._reject(
                f"features (f, m) and atoms (f,) do not fit: {shape} and {self.atoms.shape}"
            )
        if self.images is not None and len(self.images) != frames:
            self._reject(f"{len(self.images)} images for {frames} frames")
        if re.fullmatch(GOAL_NAME, self.goal) is None:
            self._reject(
                f"{self.goal[:80]!r} is no name of a goal: up to 64 letters, digits, spaces, '.', '_' and '-'"
            )
        if self.ahead is not None:
            moderate = bool((np.abs(self.ahead) <= 1.0).all())
            if self.ahead.shape != (frames,) or not moderate:
                self._reject(f"ahead must be {frames} numbers of -1 to 1")
        if self.odometry is not None and self.odometry.shape != (frames, 3):
            self._reject(f"odometry {self.odometry.shape} for {frames} frames")

    def _reject(self, reason: str) -> NoReturn:
        raise ValueError(f"demonstration {self.name}: {reason}")

    @property
    def rows(self) -> Float32s:
        """All its features as one array, (f, m)."""
        if isinstance(self.features, np.ndarray):
            return self.features
        return np.stack(list(every(self.features)))


def check_features(demonstrations: Sequence[Demonstration], size: int) -> None:
    """Raise ValueError if there is no demonstration, or one has another number of features a frame."""
    if not demonstrations:
        raise ValueError("there is no demonstration to learn from")
    for demonstration in demonstrations:
        if not isinstance(demonstration, Demonstration):
            raise TypeError(
                f"a demonstration is needed, got {type(demonstration).__name__}; smal.fit takes "
                "(images, atoms, odometry), smal.recordings.read(path) reads recordings"
            )
        features = demonstration.features
        if len(features) and len(features[0]) != size:
            raise ValueError(
                f"demonstration {demonstration.name}: {len(features[0])} features a frame, the settings ask for {size}"
            )


def every(
    arrays: AnyArray | Sequence[AnyArray], parallel: Parallel = in_parallel
) -> Iterable[AnyArray]:
    """Yield arrays in order; arrays that are computed on access are computed on every core."""
    return parallel(call, tasks_of(arrays, range(len(arrays))))


class Made(Sequence[Any]):
    """A sequence of arrays, such as images or features, that are computed on access.

    `task` returns the computation of an array by its number, for this process or another.
    """

    def __init__(self, count: int, task: Callable[[int], Task]) -> None:
        self._count = count
        self.task = task

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 - numbers or slices
        chosen = range(self._count)[index]
        if isinstance(chosen, int):
            return self.task(chosen)()
        return Made(len(chosen), lambda k: self.task(chosen[k]))


def task_of(arrays: AnyArray | Sequence[AnyArray], number: int) -> Task:
    """Return the computation of an array by its number."""
    if isinstance(arrays, Made):
        return arrays.task(number)
    return partial(np.asarray, arrays[number])


def tasks_of(arrays: AnyArray | Sequence[AnyArray], numbers: Sequence[int]) -> Sequence[Task]:
    """Return the computations of some arrays, lazily."""
    return Made(len(numbers), lambda k: partial(task_of, arrays, numbers[k]))


def selected(arrays: AnyArray | Sequence[AnyArray], numbers: Sequence[int]) -> Made:
    """Return some arrays of a sequence, lazily."""
    return Made(len(numbers), lambda k: task_of(arrays, numbers[k]))


def described(images: Sequence[Image], features: FeatureSettings, drive: str = "") -> Made:
    """Return the raw features of images, each computed on access; errors name the drive."""

    def task(frame: int) -> Task:
        where = f"{drive}, frame {frame}: " if drive else ""
        return partial(_extracted, task_of(images, frame), features, where)

    return Made(len(images), task)


def seen_by(images: Sequence[Image], features: FeatureSettings) -> Made:
    """Return images as small as features look at them, each shrunk on access."""
    return Made(len(images), lambda frame: partial(_shrunk, task_of(images, frame), features))


def _shrunk(image: Task, features: FeatureSettings) -> Image:
    return looked_at(image(), features)


def _extracted(image: Task, features: FeatureSettings, where: str) -> Float32s:
    try:
        return extract(image(), features)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from None


def chained(parts: Sequence[Sequence[AnyArray] | AnyArray]) -> Made:
    """Return sequences of arrays as one lazy sequence."""
    ends = np.cumsum([len(part) for part in parts])

    def task(index: int) -> Task:
        part = int(np.searchsorted(ends, index, side="right"))
        start = int(ends[part - 1]) if part else 0
        return task_of(parts[part], index - start)

    return Made(int(ends[-1]), task)


@dataclass(frozen=True)
class DriveUse:
    """How many frames of a drive teach."""

    drive: str
    frames: int
    used: int
    #: Why frames do not teach, or how gaps between frames were bridged.
    note: str = ""


@dataclass(frozen=True, eq=False)
class Drive:
    """A whole drive: its parts joined."""

    #: Names of its parts.
    names: tuple[str, ...]
    whole: Demonstration
    #: Ticks that were lost after a frame, by frame.
    gaps: Mapping[int, int]

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.whole.episode or self.whole.name

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.whole.atoms)

    @property
    def unfit(self) -> str:
        """Why no map can be learned from the drive; empty if a map can."""
        if self.whole.images is None:
            return "it has no images"
        if not self.whole.successful:
            return "it does not end at the goal"
        return ""


def whole_drives(demonstrations: Iterable[Demonstration]) -> list[Drive]:
    """Join the parts of each drive."""
    drives: dict[str, list[Demonstration]] = {}
    for demonstration in demonstrations:
        drives.setdefault(demonstration.episode or demonstration.name, []).append(demonstration)
    return [_whole(parts) for parts in drives.values()]


def _whole(parts: Sequence[Demonstration]) -> Drive:
    images = [part.images for part in parts if part.images is not None]
    ends = np.cumsum([len(part.atoms) for part in parts]).tolist()
    later = zip(ends[:-1], parts[1:], strict=True)
    joined = replace(
        parts[-1],
        features=chained([part.features for part in parts]),
        atoms=_together([part.atoms for part in parts]),
        images=chained(images) if len(images) == len(parts) else None,
        odometry=_joined([part.odometry for part in parts]),
        ahead=_joined([part.ahead for part in parts]),
        lost=parts[0].lost,
    )
    return Drive(
        tuple(part.name for part in parts), joined, {end - 1: part.lost for end, part in later}
    )


def _joined(parts: Sequence[NDArray[_T] | None]) -> NDArray[_T] | None:
    known = [part for part in parts if part is not None]
    return _together(known) if len(known) == len(parts) else None


def _together(parts: Sequence[NDArray[_T]]) -> NDArray[_T]:
    """Concatenate arrays without copying a single one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
