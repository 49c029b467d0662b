"""Taught drives of a model, found in recordings: a model keeps features, but no images."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.experiments.showing.summary import taught_drives
from services.recordings.dataset import Teacher
from services.recordings.recorded import RecordedEpisode, episode_of, ticks_of
from smal.model import Model
from smal.paper.model import PaperModel
from smal.teaching.demonstration import Demonstration, whole_drives


@dataclass(frozen=True, eq=False)
class TaughtDrives:
    """Taught drives by number, a line for each missing drive, and remarks."""

    found: dict[int, Demonstration]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]
    #: True poses (k, 3) of the keyframes, if the recordings of all drives contain them.
    truth: NDArray[np.float64] | None = None


def find_drives(model: Model | PaperModel, recordings: Iterable[Path]) -> TaughtDrives:
    """Find the drives of a model by the names of their parts, and check their frames."""
    shortest = 1 if isinstance(model, Model) else model.sequence_length
    names = {episode_of(name) for one in taught_drives(model) for name in one.parts}
    teacher = Teacher(model.feature_settings, shortest, include_runs=True, episodes=names)
    read = [episode for path in recordings for episode in teacher.read(path)]
    recorded = {one.name: one for one in teacher.teaching.demonstrations}
    whole: dict[tuple[str, ...], Demonstration] = {(name,): one for name, one in recorded.items()}
    whole |= {drive.names: drive.whole for drive in whole_drives(recorded.values())}
    found = {}
    missing = []
    for number, (parts, count, _) in enumerate(taught_drives(model)):
        one = whole.get(parts)
        fault = _fault(one, count)
        if one is None or fault:
            missing.append(f"{printable(', '.join(parts))}: {fault}")
        else:
            found[number] = one
    truth = None if missing or not isinstance(model, Model) else _truth(model, read)
    return TaughtDrives(found, tuple(missing), tuple(teacher.teaching.lines()), truth)


def _truth(model: Model, read: list[RecordedEpisode]) -> NDArray[np.float64] | None:
    """Return the true poses (k, 3) of the keyframes, or None if a pose was not recorded."""
    taught = model.mapped
    episodes = {episode.episode: episode for episode in read}
    first = taught.drives.searchsorted(range(taught.drive_count))
    poses = []
    for key, drive in zip(taught.keyframes.tolist(), taught.key_drives.tolist(), strict=True):
        names = taught.names[drive]
        episode = episodes[episode_of(names[0])]
        frame = key - int(first[drive])
        ticks = ticks_of(names, int(taught.frames[drive])) or sorted(episode.images)
        pose = episode.poses.get(ticks[frame])
        if pose is None:
            return None
        poses.append(pose.pose)
    return np.array(poses)


def _fault(recorded: Demonstration | None, frames: int) -> str:
    """Return why the recording of this name is not the taught drive of this length, if so."""
    if recorded is None:
        return "recording not found"
    if len(recorded.atoms) != frames:
        return "the recording of this name is of another drive"
    return "its recording lacks images" if recorded.images is None else ""
