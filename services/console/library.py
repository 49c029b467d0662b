"""What was recorded and learned: the files that the page lists, below the root."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Final

from pydantic import TypeAdapter, ValidationError

from schemas.base import MAX_TICK
from schemas.codec import printable
from schemas.rpc import FileName
from services.console.listing import Readers, Recording
from services.kit.root import OutsideError, below, name_below, open_below
from services.recordings.taught import episode_of
from smal.files import container
from smal.files.container import ModelError
from smal.files.stored import FORMAT_VERSION

#: Folders below the root: of the drives, unless the recorder says otherwise, and of the models that are learned here.
DRIVES: Final = "drives"
MODELS: Final = "models"
#: How often what is known is shown while many recordings are read.
_SHOW_S: Final = 1.0
#: Drives of a model that the page lists.
_MOST_DRIVES: Final = 1000
_NAME: Final[TypeAdapter[str]] = TypeAdapter(FileName)
_Stamp = tuple[int, int]


@dataclass(frozen=True)
class LearnedModel:
    """A model as the page lists it."""

    name: str
    when_s: float
    size: int
    #: Of one for the paper's scheme, none: that goes to the nearest.
    goals: tuple[str, ...] = ()
    #: Episodes that it was learned from.
    episodes: frozenset[str] = frozenset()
    #: Features that it was learned on.
    fingerprint: str = ""
    #: Frames of its longest drive.
    longest: int = 0
    #: Why it cannot be used; empty where it can.
    useless: str = ""


class Library:
    """Recordings and models below a root, looked at again where they have changed.

    ``look`` is called on one thread; everything else on any.

    Parameters
    ----------
    root
        Folder of the files that browsers may name, without links in its path.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        #: Name of the folder of the recordings; None where it lies outside of the root.
        self.folder: str | None = DRIVES
        self._lock = Lock()
        self._recordings: dict[Path, tuple[_Stamp, Recording]] = {}
        self._models: dict[Path, tuple[_Stamp, LearnedModel]] = {}

    def record_in(self, folder: Path) -> None:
        """Take note of where the recorder records."""
        self.folder = name_below(self.root, folder)

    def look(self, show: Callable[[dict[str, object]], None] = lambda _: None) -> dict[str, object]:
        """Look at what is there; return it for the page.

        Parameters
        ----------
        show
            Is given what is known so far, now and then while recordings are read.
        """
        stamps = dict(self._files(self._recording_files()))
        models = {path: self._model(path, stamp) for path, stamp in self._files(self._model_files())}
        with self._lock:
            self._recordings = {path: known for path, known in self._recordings.items() if path in stamps}
            self._models = models
        anew = [path for path in stamps if self._recordings.get(path, (None,))[0] != stamps[path]]
        shown_s = time.monotonic()
        with Readers() as readers:
            for path in sorted(anew, key=lambda path: stamps[path], reverse=True):
                changed_ns, size = stamps[path]
                listed = Recording(path.relative_to(self.root).as_posix(), changed_ns / 1e9, size)
                recording = readers.read(path, listed)
                with self._lock:
                    self._recordings[path] = stamps[path], recording
                if time.monotonic() - shown_s > _SHOW_S:
                    show(self._shown())
                    shown_s = time.monotonic()
        return self._shown()

    def _shown(self) -> dict[str, object]:
        newest_first = sorted(self.recordings(), key=lambda one: -one.when_s)
        return {
            "folder": self.folder,
            "recordings": [asdict(one) | {"thumbnails": len(one.thumbnails)} for one in newest_first],
            "models": [self._model_shown(one) for one in sorted(self.models(), key=lambda one: -one.when_s)],
        }

    def _model_shown(self, model: LearnedModel) -> dict[str, object]:
        """Return a model as the page lists it, with the worlds that it was taught in as far as its recordings tell."""
        worlds = {one.world for one in self.recordings() if one.episode in model.episodes and one.world}
        return asdict(model) | {"episodes": len(model.episodes), "worlds": sorted(worlds)}

    def recording(self, name: str) -> Recording | None:
        """Return a recording by its name."""
        return next((one for one in self.recordings() if one.name == name), None)

    def model(self, name: str) -> LearnedModel | None:
        """Return a model by its name."""
        return next((one for one in self.models() if one.name == name), None)

    def leads_to(self, model: LearnedModel) -> str:
        """Return where a run is said to lead that goes to the nearest goal: of several nobody knows which that is.

        What a model does not tell, the recordings do that it was learned from, as far as they are there.
        """
        recorded = {one.goal for one in self.recordings() if one.episode in model.episodes and one.goal}
        match tuple(model.goals or recorded):
            case ():
                return "victim"
            case (only,):
                return only
        return "nearest"

    def recordings(self) -> list[Recording]:
        """Return all recordings."""
        with self._lock:
            return [one for _, one in self._recordings.values()]

    def models(self) -> list[LearnedModel]:
        """Return all models."""
        with self._lock:
            return [one for _, one in self._models.values()]

    def path(self, name: str) -> Path:
        """Return the path of something that is listed.

        Raises
        ------
        OSError
            When a link leads out of the root.
        """
        return below(self.root, name)

    def delete(self, name: str) -> None:
        """Delete something that is listed; of a link, itself, and not what it leads to.

        Raises
        ------
        OSError
            When it cannot be deleted.
        """
        folder, _, last = name.rpartition("/")
        (below(self.root, folder) / last).unlink()

    def _recording_files(self) -> Iterator[Path]:
        if self.folder is not None:
            yield from (self.root / self.folder).glob("*.mcap")

    def _model_files(self) -> Iterator[Path]:
        yield from self.root.glob("*.smal")
        yield from (self.root / MODELS).glob("*.smal")

    def _files(self, paths: Iterable[Path]) -> Iterator[tuple[Path, _Stamp]]:
        """Give those that may be named, with what tells whether they have changed."""
        for path in paths:
            try:
                _NAME.validate_python(path.relative_to(self.root).as_posix())
                stat = below(self.root, path.relative_to(self.root).as_posix()).stat()
            except (OutsideError, ValidationError, OSError):
                continue
            yield path, (stat.st_mtime_ns, stat.st_size)

    def _model(self, path: Path, stamp: _Stamp) -> tuple[_Stamp, LearnedModel]:
        known = self._models.get(path)
        if known is not None and known[0] == stamp:
            return known
        name = path.relative_to(self.root).as_posix()
        listed = LearnedModel(name, stamp[0] / 1e9, stamp[1])
        try:
            with open_below(self.root, name) as file:
                meta = container.read_meta(file, name, FORMAT_VERSION)
            mapped = meta["map"] if meta["scheme"] == "filter" else {"goals": (), "names": [meta["names"]]}
            if max(len(mapped["goals"]), len(mapped["names"])) > _MOST_DRIVES or not 0 < meta["longest"] <= MAX_TICK:
                raise ValueError(f"more than {_MOST_DRIVES} drives, or none of its length")
            goals = tuple(sorted({printable(str(goal)) for goal in mapped["goals"]}))
            episodes = frozenset(episode_of(str(name)) for names in mapped["names"] for name in names)
            fingerprint, longest = printable(str(meta["feature_fingerprint"])), int(meta["longest"])
            return stamp, replace(listed, goals=goals, episodes=episodes, fingerprint=fingerprint, longest=longest)
        except (ModelError, LookupError, TypeError, ValueError, ArithmeticError, OSError) as error:
            return stamp, replace(listed, useless=printable(str(error)).removeprefix(f"{name}: "))
