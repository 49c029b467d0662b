"""Recordings and models below the root, as the page lists them."""

import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Lock
from typing import Final, NamedTuple

from pydantic import TypeAdapter, ValidationError

from schemas.base import MAX_TICK
from schemas.codec import printable
from schemas.rpc import FileName
from services.console.listing import ListedRecording, Reader, RecordedMoments
from services.kit.node import ServiceError
from services.kit.root import OutsideError, below, open_below
from services.recordings.recorded import episode_of
from smal.files import container
from smal.files.container import ModelError
from smal.files.stored import FORMAT_VERSION

#: Folders below the root: recordings, unless the recorder reports another folder, and learned
#: models.
DRIVES: Final = "drives"
MODELS: Final = "models"
_SHOW_S: Final = 1.0  # Interval of partial listings while recordings are read.
_MOST_DRIVES: Final = 1000  # Maximum number of a listed model's drives.
_NAME: Final[TypeAdapter[str]] = TypeAdapter(FileName)


class _File(NamedTuple):
    """A file below the root; a changed file is a different value."""

    name: str
    changed_ns: int
    size: int

    @property
    def when_s(self) -> float:
        return self.changed_ns / 1e9


@dataclass(frozen=True)
class LearnedModel:
    """A model as the page lists it."""

    name: str
    when_s: float
    size: int
    goals: tuple[str, ...] = ()  # Empty for the paper's scheme, which drives to the nearest goal.
    episodes: frozenset[str] = frozenset()  # Episodes that the model was learned from.
    fingerprint: str = ""  # Fingerprint of the model's features.
    longest: int = 0  # Frames of the longest drive.
    world: str = ""  # World of all its drives; empty if it is unknown.
    useless: str = ""  # Reason why it is unusable; empty if usable.


class Library:
    """Recordings and models below a root, read again after changes; ``look`` is for one thread."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder: str | None = DRIVES  # Folder of the recordings; None outside the root.
        self._lock = Lock()
        self._recordings: dict[_File, ListedRecording] = {}
        self._models: dict[_File, LearnedModel] = {}
        self._reader = Reader()
        # Moments of the recording that was asked for last, and their reader.
        self._moments: tuple[ListedRecording, RecordedMoments] | None = None
        self._moments_lock = Lock()
        self._moments_reader = Reader()
        self._closed = Event()

    def close(self) -> None:
        """Stop a running ``look`` soon."""
        self._closed.set()
        self._reader.stop()
        self._moments_reader.stop()

    def look(self, show: Callable[[dict[str, object]], None] = lambda _: None) -> dict[str, object]:
        """List the files for the page; ``show`` receives partial lists during the reading."""
        files = (
            set() if self.folder is None else self._files((self.root / self.folder).glob("*.mcap"))
        )
        models = self._files([*self.root.glob("*.smal"), *(self.root / MODELS).glob("*.smal")])
        with self._lock:
            self._recordings = {
                file: known for file, known in self._recordings.items() if file in files
            }
            self._models = {file: self._models.get(file) or self._model(file) for file in models}
        shown_s = time.monotonic()
        with closing(self._reader):
            for file in sorted(files - self._recordings.keys(), key=lambda file: -file.changed_ns):
                if self._closed.is_set():
                    break
                recording = self._reader.read(
                    self.root / file.name, ListedRecording(file.name, file.when_s, file.size)
                )
                with self._lock:
                    self._recordings[file] = recording
                if time.monotonic() - shown_s > _SHOW_S:
                    show(self._shown())
                    shown_s = time.monotonic()
        return self._shown()

    def recordings(self) -> list[ListedRecording]:
        """Return all recordings, the newest first."""
        with self._lock:
            return sorted(self._recordings.values(), key=lambda one: -one.when_s)

    def models(self) -> list[LearnedModel]:
        """Return all models, the newest first."""
        with self._lock:
            return sorted(self._models.values(), key=lambda one: -one.when_s)

    def recording(self, name: str) -> ListedRecording | None:
        """Return a recording by name."""
        return next((one for one in self.recordings() if one.name == name), None)

    def moments(self, recording: ListedRecording) -> RecordedMoments:
        """Return moments of a listed recording; thread-safe, RecordingError if it is unreadable."""
        with self._moments_lock:
            if self._moments is None or self._moments[0] is not recording:
                with closing(self._moments_reader) as reader:
                    self._moments = recording, reader.moments(self.path(recording.name))
            return self._moments[1]

    def model(self, name: str) -> LearnedModel:
        """Return a usable model by name; raises ServiceError without one."""
        model = next((one for one in self.models() if one.name == name), None)
        if model is None or model.useless:
            raise ServiceError(f"{name}: {'model not found' if model is None else model.useless}")
        return model

    def leads_to(self, model: LearnedModel) -> str:
        """Return the goal of a run to the nearest goal, from the model or from its recordings."""
        goals = set(model.goals) or {one.goal for one in self._taught_by(model) if one.goal}
        return goals.pop() if len(goals) == 1 else "nearest" if goals else "victim"

    def path(self, name: str) -> Path:
        """Return the path of a listed file; raises OSError for links out of the root."""
        return below(self.root, name)

    def delete(self, name: str) -> None:
        """Delete a file, or a link itself; raises ServiceError if it is not listed."""
        self._listed(name).unlink()

    def rename(self, name: str, label: str) -> None:
        """Rename a file in its folder; raises ServiceError if it is not listed, or for a taken name."""
        old = self._listed(name)
        new = old.with_name(label + old.suffix)
        if new.exists():
            raise ServiceError(f"{label} already exists; choose another name")
        old.rename(new)

    def _listed(self, name: str) -> Path:
        """Return the path of a recording or model, without following a link."""
        recorded = any(one.name == name for one in self.recordings())
        if not recorded and all(one.name != name for one in self.models()):
            raise ServiceError("file not found; it was deleted or renamed")
        folder, _, last = name.rpartition("/")
        return below(self.root, folder) / last

    def _taught_by(self, model: LearnedModel) -> list[ListedRecording]:
        return [one for one in self.recordings() if one.episode in model.episodes]

    def _shown(self) -> dict[str, object]:
        recordings = [one.shown() for one in self.recordings()]
        models = [
            {
                "name": one.name,
                "goals": one.goals,
                "useless": one.useless,
                "when_s": one.when_s,
                # The model's own world; older models do not hold it, but their recordings do.
                "worlds": [one.world]
                if one.world
                else sorted({taught.world for taught in self._taught_by(one) if taught.world}),
            }
            for one in self.models()
        ]
        return {"folder": self.folder, "recordings": recordings, "models": models}

    def _files(self, paths: Iterable[Path]) -> set[_File]:
        """Return the files with valid names below the root."""
        files = set()
        for path in paths:
            try:
                name = _NAME.validate_python(path.relative_to(self.root).as_posix())
                stat = below(self.root, name).stat()
            except (OutsideError, ValidationError, OSError):
                continue
            files.add(_File(name, stat.st_mtime_ns, stat.st_size))
        return files

    def _model(self, file: _File) -> LearnedModel:
        listed = LearnedModel(file.name, file.when_s, file.size)
        try:
            with open_below(self.root, file.name) as opened:
                meta = container.read_meta(opened, file.name, FORMAT_VERSION)
            mapped = (
                meta["map"]
                if meta["scheme"] == "filter"
                else {"goals": (), "names": [meta["names"]]}
            )
            if (
                max(len(mapped["goals"]), len(mapped["names"])) > _MOST_DRIVES
                or not 0 < meta["longest"] <= MAX_TICK
            ):
                raise ValueError(f"invalid: more than {_MOST_DRIVES} drives, or an invalid length")
            goals = tuple(sorted({printable(str(goal)) for goal in mapped["goals"]}))
            episodes = frozenset(
                episode_of(str(name)) for names in mapped["names"] for name in names
            )
            fingerprint = printable(str(meta["feature_fingerprint"]))
            longest = int(meta["longest"])
            return replace(
                listed,
                goals=goals,
                episodes=episodes,
                fingerprint=fingerprint,
                longest=longest,
                world=printable(str(meta.get("world", ""))),
            )
        except (ModelError, LookupError, TypeError, ValueError, ArithmeticError, OSError) as error:
            return replace(listed, useless=printable(str(error)).removeprefix(f"{file.name}: "))
