"""Taught drives of a model, found in recordings: a model keeps features, but no images."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from schemas.codec import printable
from services.experiments.showing.summary import taught_drives
from services.recordings.dataset import Teacher
from services.recordings.recorded import episode_of
from smal.model import Model
from smal.paper.model import PaperModel
from smal.teaching.demonstration import Demonstration, whole_drives


@dataclass(frozen=True, eq=False)
class TaughtDrives:
    """Taught drives by number, a line for each missing drive, and remarks."""

    found: dict[int, Demonstration]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]


def find_drives(model: Model | PaperModel, recordings: Iterable[Path]) -> TaughtDrives:
    """Find the drives of a model by the names of their parts, and check their frames."""
    shortest = 1 if isinstance(model, Model) else model.sequence_length
    episodes = {episode_of(name) for one in taught_drives(model) for name in one.parts}
    teacher = Teacher(model.feature_settings, shortest, include_runs=True, episodes=episodes)
    for path in recordings:
        teacher.read(path)
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
    return TaughtDrives(found, tuple(missing), tuple(teacher.teaching.lines()))


def _fault(recorded: Demonstration | None, frames: int) -> str:
    """Return why the recording of this name is not the taught drive of this length, if so."""
    if recorded is None:
        return "recording not found"
    if len(recorded.atoms) != frames:
        return "the recording of this name is of another drive"
    return "its recording lacks images" if recorded.images is None else ""
