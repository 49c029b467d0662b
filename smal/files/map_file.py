"""A visual map as a file: its arrays are the fields of `VisualMap`, and are checked before a robot goes by it."""

import re
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from smal.camera import TURNS_DEG
from smal.files.stored import Content
from smal.likelihood import GRID, SHARES
from smal.movement import Atom
from smal.settings import SETTINGS

if TYPE_CHECKING:
    from smal.model import VisualMap

GOAL_NAME = r"\w[\w .-]{0,63}"  # Letters, digits, and what may stand between them.
_LONGEST = 1e6  # What numbers of a map can be.
_MOST_KEYFRAMES = 400_000  # Keyframes: 300 km of usual views.
_NUMBERS: dict[str, Callable[[float], bool]] = {
    **dict.fromkeys(("aside", "correlation_length", "correlation_rad", "tick_s"), lambda one: 1e-6 <= one <= _LONGEST),
    "gamma": lambda one: 0.0 < one <= 1e3,
    "next_correlation": lambda one: 0.0 < one < 1.0,
}
#: Axes of its arrays.
_AXES = {
    "poses": 2, "drives": 1, "keyframes": 1, "basis": 2, "views": 4, "blank": 1, "movements": 2, "scene": 1,
    "log_ratio": 2, "stitched": 2, "stitch_offsets": 2, "looks": 1,
}  # fmt: skip
_WHOLE = ("drives", "keyframes", "views", "stitched", "looks")


def check_map(one: "VisualMap") -> None:
    """Check that a map cannot fail, or give a belief that is no number, while driving; ValueError names wrong parts."""
    wrong = _unsound(one) or [name for name, fits in _fit(one).items() if not fits]
    if wrong:
        raise ValueError(f"the parts of the visual map do not fit together: {', '.join(wrong)}")


def _unsound(one: "VisualMap") -> list[str]:
    """Name the parts that are not what they should be, whatever the others are."""
    wrong = [name for name, axes in _AXES.items() if not _sound(getattr(one, name), axes, "fi"[name in _WHOLE])]
    for name, fits in _NUMBERS.items():
        number = getattr(one, name)
        if type(number) not in (int, float) or not fits(number):
            wrong.append(name)
    odometry: object = one.odometry
    return wrong if isinstance(odometry, bool) else [*wrong, "odometry"]


def _fit(one: "VisualMap") -> dict[str, bool]:
    frames, count, joined = len(one.poses), len(one.keyframes), len(one.stitched)
    ends = np.flatnonzero(np.diff(one.drives, prepend=-1, append=-1))
    keys, offsets = one.keyframes, one.stitch_offsets
    return {
        "poses": one.poses.shape == (frames, 3) and bool((np.abs(one.poses) <= _LONGEST).all()),
        "drives": one.drives.shape == (frames,) and bool(np.isin(np.diff(one.drives, prepend=0), (0, 1)).all()),
        "keyframes": 0 < count <= _MOST_KEYFRAMES
        and _within(keys, frames)
        and bool((np.diff(keys, prepend=-1) > 0).all()),
        "ends of drives": bool(np.isin([*ends[:-1], *(ends[1:] - 1)], keys).all()),
        "views": one.views.dtype == np.int8
        and one.views.shape == (count + len(one.looks), 3, TURNS_DEG.size, one.basis.shape[1]),
        "blank": one.blank.shape == (one.basis.shape[1],) and float(np.linalg.norm(one.blank)) < 1.01,
        "components": 0 < one.basis.shape[1] <= len(one.basis) and bool((np.abs(one.basis) <= _LONGEST).all()),
        "log_ratio": one.log_ratio.shape == (SHARES.size, GRID.size) and bool((np.abs(one.log_ratio) < 100.0).all()),
        "movements": one.movements.shape == (len(Atom), 2) and bool((np.abs(one.movements) <= _LONGEST).all()),
        "scene": one.scene.shape == (3,) and bool((np.abs(one.scene) <= _LONGEST).all()),
        "goals": len(one.goals) == int(one.drives.max(initial=-1)) + 1
        and {*map(type, one.goals)} <= {str}
        and all(re.fullmatch(GOAL_NAME, name) for name in one.goals),
        "names": len(one.names) == len(one.goals)
        and all(parts and {*map(type, parts)} == {str} for parts in one.names),
        "stitched": one.stitched.shape == (joined, 2)
        and _within(one.stitched, count)
        and len(np.unique(one.stitched, axis=0)) == joined,
        "size": _is_size(one.size),
        "looks": _within(one.looks, count) and bool((np.bincount(one.looks) < SETTINGS.looks).all()),
        "stitch_offsets": offsets.shape == (joined, 3) and bool((np.abs(offsets) <= _LONGEST).all()),
    }


def _is_size(size: tuple[object, ...]) -> bool:
    return len(size) == 2 and all(type(side) is int and 0 < side <= _LONGEST for side in size)


def _within(numbers: NDArray[Any], count: int) -> bool:
    return bool(((numbers >= 0) & (numbers < count)).all())


def content_of_map(one: "VisualMap") -> Content:
    """Return what the file says of a map, and the arrays in it."""
    each = {part.name: getattr(one, part.name) for part in fields(one)}
    arrays = {name: value for name, value in each.items() if isinstance(value, np.ndarray)}
    numbers = {name: value for name, value in each.items() if name not in arrays}
    return numbers, arrays


def parts_of_map(numbers: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the parts of the map that a file says; errors as of `Stored.of_content`."""
    goals, names, size = numbers["goals"], numbers["names"], numbers["size"]
    if not (isinstance(goals, list) and isinstance(names, list) and all(isinstance(each, list) for each in names)):
        raise TypeError("the goals of the map must be a list, and the names of its drives lists")
    if not isinstance(size, list):
        raise TypeError("the size of the taught images must be a list")
    told = {"goals": tuple(goals), "names": tuple(map(tuple, names)), "size": tuple(size)}
    return arrays | numbers | told


def _sound(array: object, axes: int, kind: str) -> bool:
    if not isinstance(array, np.ndarray):
        return False
    kinds = array.dtype.kind == kind and (kind == "i" or array.dtype.itemsize >= 4)
    return array.ndim == axes and kinds and bool(np.isfinite(array).all())
