"""The drives that a model was taught, found again in recordings: a model keeps features, and no image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.codec import printable
from services.recordings.dataset import Teacher
from services.recordings.taught import episode_of
from smal.paper.learning import Demonstration
from smal.paper.model import Model
from smal.paper.sequences import first_frame


@dataclass(frozen=True, eq=False)
class TaughtDrives:
    """What recordings hold of what a model was taught.

    Parameters
    ----------
    demonstrations : tuple
        One for each of the model, None for one that was not found.
    missing : tuple of str
        One line for each that was not found, or has no images: which, and why.
    remarks : tuple of str
        What reading the recordings said.
    """

    demonstrations: tuple[Demonstration | None, ...]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]


def find_drives(model: Model, recordings: Iterable[Path]) -> TaughtDrives:
    """Find the drives of a model by their names, and make sure by their commands and features that it is them."""
    teacher = Teacher(
        model.feature_settings,
        model.sequence_length,
        include_runs=True,
        episodes={episode_of(name) for name in model.names},
    )
    for path in recordings:
        teacher.read(path)
    named: dict[str, list[Demonstration]] = {}
    for one in teacher.teaching.demonstrations:
        named.setdefault(one.name, []).append(one)
    found: list[Demonstration | None] = []
    missing = []
    for number, (name, new) in enumerate(zip(model.names, first_seen(model), strict=True)):
        same = [one for one in named.get(name, []) if _taught(model, number, new, one)]
        found.append(same[0] if same else None)
        if name not in named:
            missing.append(f"{printable(name)}: not among the recordings")
        elif not same:
            missing.append(f"{printable(name)}: the recording of this name is of another drive")
        elif same[0].images is None:
            missing.append(f"{printable(name)}: its recording lacks images")
    return TaughtDrives(tuple(found), tuple(missing), tuple(teacher.teaching.remarks))


def first_seen(model: Model) -> list[dict[int, int]]:
    """Return for each demonstration the states that it was the first to show, each with its first frame there."""
    seen: set[int] = set()
    each = []
    for stream, atoms in zip(model.state_streams, model.atoms, strict=True):
        start = first_frame(len(atoms), model.sequence_length)
        new: dict[int, int] = {}
        for number, state in enumerate(stream.tolist()):
            if state not in seen:
                seen.add(state)
                new[state] = start + number * model.sequence_length
        each.append(new)
    return each


def _taught(model: Model, number: int, new: dict[int, int], one: Demonstration) -> bool:
    """Whether this is what the model was taught: the same commands, and the very features of the states it gave."""
    if not np.array_equal(one.atoms, model.atoms[number]):
        return False
    length = model.sequence_length
    rows = [first + k for first in new.values() for k in range(length)]
    columns = [state * length + k for state in new for k in range(length)]
    centred = model.centering.apply(one.features[rows])
    # Computed anew, on another machine, they may differ by rounding.
    return bool(np.allclose(centred, model.templates[:, columns].T, atol=1e-3))
