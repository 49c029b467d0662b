"""What a person teaches by: a drive with the camera, the movements that were made, and the wheels."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import call
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from smal.camera import Camera, Image
from smal.features.extraction import Parallel, extract, in_parallel
from smal.features.settings import FeatureSettings
from smal.map import GOAL_NAME
from smal.sought.learning import Box

USUAL_GOAL = "victim"  # Where drives lead that do not say so.

Task = Callable[[], Any]  # Makes an array.
_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A drive of a person or the expert, or a part of one where frames were lost: f frames.

    ValueError where lengths do not fit each other, or numbers are out of range; it names the demonstration.
    """

    name: str  # Its episode.
    #: (f, m) raw features (`smal.features.extract`), without dropped frames; rows may be read when they are wanted.
    features: NDArray[np.float32] | Sequence[NDArray[np.float32]]
    atoms: NDArray[
        np.int8
    ]  # (f,) `Atom` k was executed between frames k and k + 1; the last one after the last frame.
    successful: bool = True  # Whether it ended at the goal.
    recovery: bool = False  # Whether it began off the route, to show the way back to it.
    images: Sequence[Image] | None = (
        None  # RGB; read when they are wanted. The map of views is made of them.
    )
    odometry: NDArray[np.float64] | None = None  # (f, 3) x, y and heading in radians by the wheels.
    episode: str = (
        ""  # Which drive it is a part of, where frames between parts were lost; its name if empty.
    )
    goal: str = USUAL_GOAL
    camera: Camera | None = None  # Estimated from the images if not given.
    #: (f,) how fast the robot went ahead in the atoms of turning, -1 to 1 times its speed straight on, as a car does;
    #: on the spot if not given.
    ahead: NDArray[np.float32] | None = None
    #: Where in the last image the goal is, if somebody has drawn it: left, top, right, bottom, shares of its size.
    box: Box | None = None

    def __post_init__(self) -> None:
        shape = getattr(self.features, "shape", (len(self.features), None))
        if len(shape) != 2 or self.atoms.shape != shape[:1]:
            raise ValueError(
                f"demonstration {self.name}: features (f, m) and atoms (f,) do not fit: {shape} and {self.atoms.shape}"
            )
        frames = len(self.atoms)
        if self.images is not None and len(self.images) != frames:
            raise ValueError(
                f"demonstration {self.name}: {len(self.images)} images for {frames} frames"
            )
        if re.fullmatch(GOAL_NAME, self.goal) is None:
            said = f"{self.goal[:80]!r} is no name of a goal: up to 64 letters, digits, spaces, '.', '_' and '-'"
            raise ValueError(f"demonstration {self.name}: {said}")
        if self.ahead is not None and not (
            self.ahead.shape == (frames,) and (np.abs(self.ahead) <= 1.0).all()
        ):
            raise ValueError(
                f"demonstration {self.name}: ahead must be {frames} numbers of -1 to 1"
            )
        if self.odometry is not None and self.odometry.shape != (frames, 3):
            raise ValueError(
                f"demonstration {self.name}: odometry {self.odometry.shape} for {frames} frames"
            )

    @property
    def rows(self) -> NDArray[np.float32]:
        """All its features at once, (f, m)."""
        return (
            self.features
            if isinstance(self.features, np.ndarray)
            else np.stack(list(every(self.features)))
        )


def check_features(demonstrations: Sequence[Demonstration], size: int) -> None:
    """Raise ValueError if there is no demonstration, or one has not so many features a frame."""
    if not demonstrations:
        raise ValueError("there is no demonstration to learn from")
    for one in demonstrations:
        if len(one.features) and len(one.features[0]) != size:
            raise ValueError(
                f"demonstration {one.name}: {len(one.features[0])} features a frame, the settings ask for {size}"
            )


def every(
    arrays: NDArray[Any] | Sequence[NDArray[Any]], parallel: Parallel = in_parallel
) -> Iterable[NDArray[Any]]:
    """Yield arrays one after the other; those that are made when they are asked for are made on every core."""
    return parallel(call, tasks_of(arrays, range(len(arrays))))


class Made(Sequence[Any]):
    """So many arrays, such as images or features, each made when it is asked for.

    `task` gives what makes the one of a number, here or in another process.
    """

    def __init__(self, count: int, task: Callable[[int], Task]) -> None:
        self._count = count
        self.task = task

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 - a sequence is asked for numbers or slices
        chosen = range(self._count)[index]
        return (
            self.task(chosen)()
            if isinstance(chosen, int)
            else Made(len(chosen), lambda k: self.task(chosen[k]))
        )


def task_of(arrays: NDArray[Any] | Sequence[NDArray[Any]], number: int) -> Task:
    """Return what makes one of some arrays."""
    return arrays.task(number) if isinstance(arrays, Made) else partial(np.asarray, arrays[number])


def tasks_of(
    arrays: NDArray[Any] | Sequence[NDArray[Any]], numbers: Sequence[int]
) -> Sequence[Task]:
    """Return what makes some of them; nothing is read before it is asked for."""
    return Made(len(numbers), lambda k: partial(task_of, arrays, numbers[k]))


def described(images: Sequence[Image], features: FeatureSettings) -> Made:
    """Return the raw features of images, each computed when it is asked for."""
    return Made(len(images), lambda frame: partial(_extracted, task_of(images, frame), features))


def _extracted(image: Task, features: FeatureSettings) -> NDArray[np.float32]:
    return extract(image(), features)


def chained(parts: Sequence[Sequence[NDArray[Any]] | NDArray[Any]]) -> Made:
    """Return sequences of arrays as one; none is read or copied before it is asked for."""
    ends = np.cumsum([len(part) for part in parts])

    def of(index: int) -> Task:
        part = int(np.searchsorted(ends, index, side="right"))
        return task_of(parts[part], index - (int(ends[part - 1]) if part else 0))

    return Made(int(ends[-1]), of)


def drives_to_goals(
    demonstrations: Iterable[Demonstration],
) -> list[tuple[tuple[str, ...], Demonstration]]:
    """Return the drives that reached their goal and have images, each with the names of its parts.

    Parts of one drive are put together: by its wheels the robot knows how far it went between them. Without odometry
    the last part alone counts.
    """
    drives: dict[str, list[Demonstration]] = {}
    for one in demonstrations:
        drives.setdefault(one.episode or one.name, []).append(one)
    whole = []
    for parts in drives.values():
        kept = parts if all(part.odometry is not None for part in parts) else parts[-1:]
        images = [part.images for part in kept if part.images is not None]
        if kept[-1].successful and len(images) == len(kept):
            joined = replace(
                kept[-1],
                features=chained([part.features for part in kept]),
                atoms=_together([part.atoms for part in kept]),
                images=chained(images),
                odometry=_joined([part.odometry for part in kept]),
                ahead=_joined([part.ahead for part in kept]),
            )
            whole.append((tuple(part.name for part in kept), joined))
    return whole


def _joined(parts: Sequence[NDArray[_T] | None]) -> NDArray[_T] | None:
    known = [part for part in parts if part is not None]
    return _together(known) if len(known) == len(parts) else None


def _together(parts: Sequence[NDArray[_T]]) -> NDArray[_T]:
    """Put arrays one after the other."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
