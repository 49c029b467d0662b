"""The drives that a model was taught, found again in recordings: a model keeps features, and no image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from schemas.codec import printable
from services.recordings.dataset import Teacher
from services.recordings.taught import episode_of
from smal.demonstration import Demonstration
from smal.model import Model
from smal.paper.model import Model as PaperModel
from smal.paper.sequences import first_frame
from smal.virtual_views import TURNS_DEG


@dataclass(frozen=True, eq=False)
class TaughtDrives:
    """What recordings hold of what a model was taught.

    A demonstration for each of the model, None for one that was not found; a line for each of those and for each
    without images, and what reading the recordings said.
    """

    demonstrations: tuple[Demonstration | None, ...]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]


def find_drives(model: Model | PaperModel, recordings: Iterable[Path]) -> TaughtDrives:
    """Find the drives of a model by their names, and make sure by what the model keeps of them that it is them."""
    if isinstance(model, Model):
        names, shortest, is_it = [name for parts in model.mapped.names for name in parts], 1, partial(_is_of_map, model)
    else:
        names, shortest, is_it = list(model.names), model.sequence_length, partial(_is_of_paper, model)
    episodes = {episode_of(name) for name in names}
    teacher = Teacher(model.feature_settings, shortest, include_runs=True, episodes=episodes)
    for path in recordings:
        teacher.read(path)
    named: dict[str, list[Demonstration]] = {}
    for one in teacher.teaching.demonstrations:
        named.setdefault(one.name, []).append(one)
    found: list[Demonstration | None] = []
    missing = []
    for number, name in enumerate(names):
        same = [one for one in named.get(name, []) if is_it(number, one)]
        found.append(same[0] if same else None)
        if name not in named:
            missing.append(f"{printable(name)}: not among the recordings")
        elif not same:
            missing.append(f"{printable(name)}: the recording of this name is of another drive")
        elif same[0].images is None:
            missing.append(f"{printable(name)}: its recording lacks images")
    return TaughtDrives(tuple(found), tuple(missing), tuple(teacher.teaching.remarks))


def _is_of_map(model: Model, number: int, one: Demonstration) -> bool:
    """Whether a demonstration is what a map was taught: its keyframes look as the map says."""
    taught = model.mapped
    drive = [drive for drive, parts in enumerate(taught.names) for _ in parts][number]
    # The map tells how long a drive is, and not its parts: of several the recordings are believed.
    if len(taught.names[drive]) > 1:
        return True
    if len(one.atoms) != taught.frames[drive]:
        return False
    keys = np.flatnonzero(taught.drives[taught.keyframes] == drive)
    frames = taught.keyframes[keys] - np.searchsorted(taught.drives, drive)
    seen = model.centering.apply(one.features[frames]) @ taught.basis
    # Computed anew, on another machine, they may differ by rounding; a view of another place does by ten times it.
    return bool(np.abs(seen - taught.views[keys, 1, TURNS_DEG.size // 2]).max() < 0.05)


def _is_of_paper(model: PaperModel, number: int, one: Demonstration) -> bool:
    """Whether it is what the paper's model was taught: the same commands, and the very features of its states."""
    if not np.array_equal(one.atoms, model.atoms[number]):
        return False
    length, new = model.sequence_length, first_seen(model)[number]
    rows = [first + k for first in new.values() for k in range(length)]
    columns = [state * length + k for state in new for k in range(length)]
    centred = model.centering.apply(one.features[rows])
    # Computed anew, on another machine, they may differ by rounding.
    return bool(np.allclose(centred, model.templates[:, columns].T, atol=1e-3))


def first_seen(model: PaperModel) -> list[dict[int, int]]:
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
