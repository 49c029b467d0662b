"""Demonstrations from recordings: usable episodes and their frames, never true poses."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.episode import in_words
from services.kit.cameras import camera_of
from services.kit.errors import UsageError
from services.recordings.encoding import decode_image
from services.recordings.reader import read_recording
from services.recordings.recorded import RecordedEpisode, piece_name
from services.recordings.records import Allowance, copied
from services.recordings.sink import first_of
from services.recordings.stream import RecordingError
from smal.features import FeatureSettings
from smal.features.extraction import check_image, in_parallel
from smal.features.resizing import same_aspect
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration, DriveUse, Made, described

Size = tuple[int, int]  # Width and height of an image, pixels.


@dataclass
class Teaching:
    """Demonstrations of a set of recordings."""

    # One for each stretch without gaps.
    demonstrations: list[Demonstration] = field(default_factory=list)
    recordings: int = 0  # Number of read files.
    #: DriveUse of each episode; learners add the use of the episodes with demonstrations.
    uses: list[DriveUse] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)  # Damage, one per line.
    worlds: set[str] = field(default_factory=set)  # Worlds of the demonstrations.

    @property
    def world(self) -> str:
        """The world of all demonstrations; empty if it is unknown or differs."""
        return "".join(self.worlds) if len(self.worlds) == 1 else ""

    def lines(self) -> list[str]:
        """Return the damage and the episodes that do not teach, one per line."""
        unused = [use for use in self.uses if not use.used]
        return [*self.remarks, *(f"episode {one.drive} left out: {one.note}" for one in unused)]


class _LeftOut(Exception):  # noqa: N818 - it is caught and reported, one episode of many
    """Raised when an episode does not teach; the text is the reason."""


class Teacher:
    """Collects the demonstrations of recordings, file by file.

    Parameters
    ----------
    features
        Features of the demonstrations, computed from an image on demand.
    shortest
        Minimum number of frames of a stretch without gaps.
    include_runs
        Whether successful runs of the robot by itself teach.
    everything
        Whether episodes that must not teach are read as well, for other uses.
    episodes
        Episodes to read; all if empty.
    taught
        Image size of the model to extend, by default the size of the first image. Images of another
        size are resized; images of another aspect ratio are left out.

    Raises
    ------
    UsageError
        If the features need depth images, which recordings do not contain.
    """

    def __init__(
        self,
        features: FeatureSettings,
        shortest: int,
        *,
        include_runs: bool = False,
        everything: bool = False,
        episodes: Collection[str] = (),
        taught: Size | None = None,
    ) -> None:
        if "depth" in features.needs:
            names = ",".join(features.modalities)
            raise UsageError(f"features {names}: recordings contain no depth images; omit depth")
        self.teaching = Teaching()
        #: Each size of images, with the first episode that has it.
        self._sizes: dict[Size, str] = {} if taught is None else {taught: "the model"}
        self._episodes = episodes
        self._features = features
        self._shortest = shortest
        self._include_runs = include_runs
        self._everything = everything
        self._seen: dict[tuple[str, str], Path] = {}
        self._allowance = Allowance()

    def read_all(
        self, paths: Sequence[Path], advance: Callable[[str, int, int], object]
    ) -> Teaching:
        """Read files, report each by ``advance``, and return all demonstrations."""
        for number, path in enumerate(paths):
            advance("reading", number, len(paths))
            self.read(path)
        advance("reading", len(paths), len(paths))
        return self.teaching

    def read(self, path: Path) -> list[RecordedEpisode]:
        """Add the demonstrations of a file; a defect becomes a remark, never an exception.

        Returns
        -------
        list of RecordedEpisode
            The episodes with demonstrations.
        """
        free = self._allowance.left
        try:
            recording = read_recording(path, self._allowance)
        except RecordingError as error:
            first = first_of(path)
            self._remark(str(error) if first is None else f"{error}; {_joined(first, path)}")
            return []
        self.teaching.recordings += 1
        self.teaching.remarks.extend(recording.remarks())
        taken = [
            episode
            for episode in recording.episodes
            if (not self._episodes or episode.episode in self._episodes)
            and self._take(path, episode)
        ]
        if not taken:
            self._allowance.left = free  # Its bytes are not kept.
        return taken

    def _take(self, path: Path, episode: RecordedEpisode) -> bool:
        """Add the demonstrations of an episode, or its reason not to teach; return whether it teaches."""
        here = f"{path}: episode {episode.episode}"
        try:
            self._check_is_first(path, episode)
            reason = unusable(episode, include_runs=self._include_runs)
            if reason and not self._everything:
                raise _LeftOut(reason)
            self._check_images(here, episode)
            pieces = self._pieces(here, episode)
        except _LeftOut as reason:
            self.teaching.uses.append(DriveUse(episode.episode, episode.frames, 0, str(reason)))
            return False
        self.teaching.worlds.add(episode.world)
        end = int(pieces[0][0])
        for ticks in pieces:
            whole = len(pieces) == 1
            name = episode.episode if whole else piece_name(episode.episode, ticks)
            demonstration = _demonstration(episode, ticks, name, self._features)
            lost = int(ticks[0]) - end
            self.teaching.demonstrations.append(replace(demonstration, lost=lost))
            end = int(ticks[-1]) + 1
        return True

    def _check_is_first(self, path: Path, episode: RecordedEpisode) -> None:
        other = self._seen.setdefault((episode.robot, episode.episode), path)
        if other != path:
            first, second = sorted((other, path), key=lambda one: len(one.name))
            join = f"; {_joined(first, second)}" if first == first_of(second) else ""
            raise _LeftOut(f"already in {other}{join}")

    def _check_images(self, here: str, episode: RecordedEpisode) -> None:
        """Delete the damaged images of an episode, and check the size of the others."""
        sizes = dict(
            zip(
                episode.images,
                in_parallel(_size_of, list(episode.images.values())),
                strict=True,
            )
        )
        damaged = [tick for tick, size in sizes.items() if size is None]
        for tick in damaged:
            del episode.images[tick]
        if damaged:
            self._remark(f"{here}: {len(damaged)} damaged images left out")
        for size in dict.fromkeys(filter(None, sizes.values())):
            self._check_size(here, size)

    def _check_size(self, here: str, size: Size) -> None:
        """Check that images are comparable with earlier images; a new size becomes a remark."""
        if size in self._sizes or not self._sizes:
            self._sizes.setdefault(size, here)
            return
        other, where = next(iter(self._sizes.items()))
        sizes = f"images of {size[0]}x{size[1]} differ from {other[0]}x{other[1]} in {where}"
        if not same_aspect(size, other):
            raise _LeftOut(f"{sizes}: another aspect ratio shows another view")
        self._sizes[size] = here
        self._remark(f"{here}: {sizes}; all are resized")

    def _pieces(self, here: str, episode: RecordedEpisode) -> list[NDArray[np.int64]]:
        """Return the ticks of each stretch that is long enough."""
        pieces = [ticks for ticks in episode.pieces() if ticks.size >= self._shortest]
        if not pieces:
            raise _LeftOut(f"fewer than {self._shortest} successive frames")
        # The last frame is not counted: unless the target was found, no movement follows it.
        lost = set(episode.images).difference(
            *map(np.ndarray.tolist, pieces), [max(episode.images)]
        )
        if lost:
            self._remark(
                f"{here}: {len(lost)} frames left out: without a movement or odometry, or in "
                f"a stretch of fewer than {self._shortest}"
            )
        return pieces

    def _remark(self, text: str) -> None:
        self.teaching.remarks.append(text)


def _joined(first: Path, second: Path) -> str:
    """Return the command that merges the two recordings of an episode after a crash."""
    return f"smal recording repair {first} {second} --out FILE merges them"


def unusable(episode: RecordedEpisode, *, include_runs: bool) -> str | None:
    """Return why an episode must not teach, or None; an episode without an end teaches no goal."""
    if episode.purpose == "run" and not include_runs:
        return "the robot drove by itself (--include-runs takes successful runs)"
    if episode.purpose == "run" and episode.outcome != "found":
        return f"the robot drove by itself without success ({in_words(episode.outcome)})"
    if episode.kidnapped:
        return f"the robot was kidnapped (frame {episode.kidnapped[0]}), unknown to its odometry"
    if episode.outcome == "collision":
        return "collision"
    if episode.purpose == "drive" and episode.outcome in ("timeout", "aborted"):
        return f"victim not reached ({in_words(episode.outcome)})"
    return None


def _size_of(payload: memoryview) -> Size | None:
    """Return the size of a recorded image; None if it is unusable for features."""
    try:
        image = decode_image(copied(payload))
        check_image(image)
    except ValueError:
        return None
    return image.shape[1], image.shape[0]


def _demonstration(
    episode: RecordedEpisode, ticks: NDArray[np.int64], name: str, features: FeatureSettings
) -> Demonstration:
    known = ticks.tolist()
    images = recorded_images([episode.images[tick] for tick in known], episode.episode)
    applied = [episode.applied.get(tick) for tick in known]
    way = [episode.odometry[tick].pose for tick in known if tick in episode.odometry]
    at_goal = episode.is_goal(known[-1])
    return Demonstration(
        name=name,
        features=described(images, features),
        atoms=np.array([Atom[episode.atom(tick).upper()] for tick in known], dtype=np.int8),
        successful=at_goal,
        recovery=episode.purpose == "recovery",
        images=images,
        odometry=np.array(way) if len(way) == len(known) else None,
        episode=episode.episode,
        goal=episode.goal,
        camera=None if episode.camera is None else camera_of(episode.camera),
        ahead=np.array([0.0 if one is None else one.linear for one in applied], dtype=np.float32),
        box=episode.box if at_goal else None,
    )


def recorded_images(
    recorded: Sequence[bytes | memoryview],
    episode: str,
    decode: Callable[[bytes], NDArray[np.uint8]] = decode_image,
) -> Made:
    """Return recorded images, decoded on demand; ValueError names a damaged episode."""
    return Made(len(recorded), lambda frame: partial(_decoded, decode, recorded[frame], episode))


def _decoded(
    decode: Callable[[bytes], NDArray[np.uint8]], payload: bytes | memoryview, episode: str
) -> NDArray[np.uint8]:
    try:
        return decode(copied(memoryview(payload)))
    except ValueError as error:
        raise ValueError(f"an image of episode {episode} is damaged: {error}") from None


def find_recordings(paths: Iterable[Path]) -> list[Path]:
    """Return the recordings among files and in folders, unfinished files too, each file once.

    Raises
    ------
    UsageError
        If a path does not exist, or a folder contains no recording.
    """
    found: dict[object, Path] = {}
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path}: not found")
        here = [path]
        if path.is_dir():
            here = sorted(p for p in path.iterdir() if p.name.endswith((".mcap", ".mcap.partial")))
            if not here:
                raise UsageError(f"{path}: no recording (*.mcap) in this folder")
        for one in here:
            found.setdefault(_identity(one), one)
    return list(found.values())


def _identity(path: Path) -> object:
    """Return an identity common to all names of a file, links included; a broken link is unique."""
    try:
        told = path.stat()
    except OSError:
        return path
    return told.st_dev, told.st_ino
