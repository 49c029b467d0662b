"""From recordings to demonstrations: which episodes teach, and what of them, but never a true pose."""

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS
from schemas.observation import Observation
from schemas.topics import OBSERVATION
from services.kit.cameras import camera_of
from services.kit.errors import UsageError
from services.kit.jpeg import is_jpeg, jpeg_size
from services.recordings.encoding import decode_image, stamped_jpeg
from services.recordings.reader import read_recording
from services.recordings.recorded import Piece, RecordedEpisode, piece_name
from services.recordings.records import Allowance, copied
from services.recordings.sink import first_of
from services.recordings.stream import RecordingError, messages_of
from smal.features import FeatureSettings, extract, select
from smal.features.extraction import check_image, in_parallel
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration, Made

#: The library's number of each movement, by its place in ``ATOMS``.
_NUMBERS: Final = np.array([Atom[name.upper()] for name in ATOMS], dtype=np.int8)
#: Ratio of two images' width over height from which they show different views: 1 % is a row in a hundred, by rounding.
_OTHER_SHAPE: Final = 1.01
Size = tuple[int, int]  # Width and height of an image, pixels.


@dataclass
class Teaching:
    """What a set of recordings teaches."""

    demonstrations: list[Demonstration] = field(default_factory=list)  # Of each piece without gaps.
    recordings: int = 0  # Files that were read.
    episodes: int = 0  # Episodes that are used.
    remarks: list[str] = field(
        default_factory=list
    )  # Of what is left out, damaged or computed anew.


class Teacher:
    """Collects the demonstrations of one recording after the other, of some ``episodes`` only, if these are given.

    Frames without the wanted features have them computed from their image, unless that takes depth. A piece needs
    ``shortest`` frames. Successful runs of the robot by itself teach only with ``include_runs``. Images may have any
    size, and the shape of the ``taught`` ones, if given, or else of the first: features of another shape are stretched.
    """

    def __init__(
        self,
        features: FeatureSettings,
        shortest: int,
        *,
        include_runs: bool = False,
        episodes: Collection[str] = (),
        taught: Size | None = None,
    ) -> None:
        self.teaching = Teaching()
        self._sizes: dict[Size, str] = (
            {} if taught is None else {taught: "the model"}
        )  # With who has it, first.
        self._episodes = episodes
        self._features = features
        self._shortest = shortest
        self._include_runs = include_runs
        self._seen: dict[tuple[str, str], Path] = {}
        self._allowance = Allowance()

    def read_all(
        self, paths: Sequence[Path], advance: Callable[[str, int, int], object]
    ) -> Teaching:
        """Read files, tell before each how many are done and how many there are, and return what all of them teach."""
        for number, path in enumerate(paths):
            advance("reading", number, len(paths))
            self.read(path)
        advance("reading", len(paths), len(paths))
        return self.teaching

    def read(self, path: Path) -> None:
        """Take what a file teaches; what it lacks becomes a remark, never an exception."""
        # Vectors of more modalities than the wanted ones hold these.
        holding = [
            held
            for held in features_in(path)
            if set(self._features.describing) <= set(held.modalities)
        ]
        held = min(holding, key=lambda held: held.size, default=self._features)
        free = self._allowance.left
        taught = len(self.teaching.demonstrations)
        try:
            recording = read_recording(path, held.fingerprint, self._allowance)
        except RecordingError as error:
            first = first_of(path)
            self._remark(str(error) if first is None else f"{error}; {_joined(first, path)}")
            return
        self.teaching.recordings += 1
        self.teaching.remarks.extend(recording.remarks())
        for episode in recording.episodes:
            if not self._episodes or episode.episode in self._episodes:
                whole = {
                    tick: one
                    for tick, one in episode.features.items()
                    if one().shape == (held.size,)
                }
                episode.features = {
                    tick: partial(_chosen, one, held, self._features) for tick, one in whole.items()
                }
                self._take(path, episode)
        if len(self.teaching.demonstrations) == taught:
            self._allowance.left = free  # nothing of it is kept

    def _take(self, path: Path, episode: RecordedEpisode) -> None:
        here = f"{path}: episode {episode.episode}"
        reason = self._unusable(path, episode)
        if reason is not None:
            self._remark(f"{here} is left out: {reason}")
            return
        damaged = [tick for tick, payload in episode.images.items() if not _is_image(payload)]
        for tick in damaged:
            del episode.images[tick]
        if damaged:
            self._remark(f"{here}: {len(damaged)} damaged images are left out")
        if episode.images and not self._fits(_size(next(iter(episode.images.values()))), here):
            return
        if not episode.features and "depth" in self._features.needs:
            lack = f"it lacks the features {','.join(self._features.modalities)}, and no image has the depth for them"
            self._remark(f"{here} is left out: {lack}")
            return
        computed = _complete(episode, self._features)
        if computed:
            self._remark(
                f"{path}: the features of {computed} frames were computed from their images"
            )
        pieces = [piece for piece in episode.pieces() if piece.ticks.size >= self._shortest]
        if not pieces:
            self._remark(f"{here} is left out: no {self._shortest} successive frames")
            return
        # The very last frame is not counted: unless the victim was found, nothing was done after it.
        recorded = episode.features.keys() | episode.images.keys()
        lost = (
            recorded - {tick for piece in pieces for tick in piece.ticks.tolist()} - {max(recorded)}
        )
        if lost:
            self._remark(f"{here}: {len(lost)} frames beside gaps are left out")
        self.teaching.episodes += 1
        self.teaching.demonstrations.extend(
            _demonstration(episode, piece, len(pieces) == 1) for piece in pieces
        )

    def _unusable(self, path: Path, episode: RecordedEpisode) -> str | None:
        other = self._seen.setdefault((episode.robot, episode.episode), path)
        if other == path:
            return unusable(episode, include_runs=self._include_runs)
        first, second = sorted((other, path), key=lambda one: len(one.name))
        return f"it is in {other} too{f'; {_joined(first, second)}' if first == first_of(second) else ''}"

    def _fits(self, size: Size, here: str) -> bool:
        """Return whether images of a size can be compared with those before; a new size becomes a remark."""
        if size in self._sizes or not self._sizes:
            self._sizes.setdefault(size, here)
            return True
        other, where = next(iter(self._sizes.items()))
        sizes = f"images of {size[0]}x{size[1]}, and {where} has {other[0]}x{other[1]}"
        ratio = size[0] * other[1] / (size[1] * other[0])
        if not 1.0 / _OTHER_SHAPE <= ratio <= _OTHER_SHAPE:
            self._remark(f"{here} is left out: {sizes}: another shape shows another view")
            return False
        self._sizes[size] = here
        self._remark(f"{here}: {sizes}; all are resized")
        return True

    def _remark(self, text: str) -> None:
        self.teaching.remarks.append(text)


def _joined(first: Path, second: Path) -> str:
    """Say how two recordings of one episode become one, as a recorder leaves them that was killed meanwhile."""
    return f"smal recording repair {first} {second} --out FILE joins them"


def unusable(episode: RecordedEpisode, *, include_runs: bool) -> str | None:
    """Say why an episode must not teach, or None; one whose end was not recorded teaches the way, but no goal."""
    if episode.purpose == "run" and not include_runs:
        return "the robot drove by itself (--include-runs takes such runs if they found the victim)"
    if episode.purpose == "run" and episode.outcome != "found":
        ended = episode.outcome or "its end was not recorded"
        return f"the robot drove by itself and did not find the victim ({ended})"
    if episode.outcome == "collision":
        return "it ended in a collision"
    if episode.purpose == "drive" and episode.outcome in ("timeout", "aborted"):
        return f"it did not reach the victim ({episode.outcome})"
    return None


def _is_image(payload: memoryview) -> bool:
    """Whether a recorded image begins as one; costs much less than to decode it."""
    try:
        return is_jpeg(stamped_jpeg(copied(payload))[1])
    except ValueError:
        return False


def _size(payload: memoryview) -> Size:
    """Return the size of a recorded image whose header was checked."""
    return cast("Size", jpeg_size(stamped_jpeg(copied(payload))[1]))


def _complete(episode: RecordedEpisode, settings: FeatureSettings) -> int:
    """Have missing features made of the images, but for depth and for damaged images; return how many."""
    if "depth" in settings.needs:
        return 0
    missing = [tick for tick in episode.images if tick not in episode.features]
    whole = compress(missing, in_parallel(lambda tick: _is_whole(episode.images[tick]), missing))
    made = {tick: partial(_described, episode.images[tick], settings) for tick in whole}
    episode.features.update(made)
    return len(made)


def _is_whole(payload: memoryview) -> bool:
    """Whether features can be made of a recorded image."""
    try:
        check_image(decode_image(copied(payload)))
    except ValueError:
        return False
    return True


def _described(payload: memoryview, settings: FeatureSettings) -> NDArray[np.float32]:
    return extract(decode_image(copied(payload)), settings)


def _chosen(
    read: Callable[[], NDArray[np.float32]], held: FeatureSettings, wanted: FeatureSettings
) -> NDArray[np.float32]:
    return select(read(), held, wanted)


def _demonstration(episode: RecordedEpisode, piece: Piece, whole: bool) -> Demonstration:
    return Demonstration(
        name=episode.episode if whole else piece_name(episode.episode, piece.ticks),
        features=piece.features,
        atoms=_NUMBERS[piece.atoms],
        successful=piece.at_goal,
        recovery=episode.purpose == "recovery",
        images=None if piece.images is None else recorded_images(piece.images, episode.episode),
        odometry=piece.odometry,
        episode=episode.episode,
        goal=episode.goal,
        camera=None if episode.camera is None else camera_of(episode.camera),
        ahead=piece.ahead,
        box=episode.box if piece.at_goal else None,
    )


def recorded_images(
    recorded: Sequence[bytes | memoryview],
    episode: str,
    decode: Callable[[bytes], NDArray[np.uint8]] = decode_image,
) -> Made:
    """Return images as they were recorded, decoded when they are wanted; ValueError names a damaged one's episode."""
    return Made(len(recorded), lambda frame: partial(_decoded, decode, recorded[frame], episode))


def _decoded(
    decode: Callable[[bytes], NDArray[np.uint8]], payload: bytes | memoryview, episode: str
) -> NDArray[np.uint8]:
    try:
        return decode(copied(memoryview(payload)))
    except ValueError as error:
        raise ValueError(f"an image of episode {episode} is damaged: {error}") from None


def find_recordings(paths: Iterable[Path]) -> list[Path]:
    """Return the recordings among files and in folders, unfinished ones too, each file once, whatever its names.

    UsageError where a path has none.
    """
    found: dict[object, Path] = {}
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path}: no such file or folder")
        here = [path]
        if path.is_dir():
            here = sorted(p for p in path.iterdir() if p.name.endswith((".mcap", ".mcap.partial")))
            if not here:
                raise UsageError(f"{path}: no recording (*.mcap) in this folder")
        for one in here:
            found.setdefault(_identity(one), one)
    return list(found.values())


def _identity(path: Path) -> object:
    """Return what the names of a file have in common, links included; of a dangling link its own name."""
    try:
        told = path.stat()
    except OSError:
        return path
    return told.st_dev, told.st_ino


def features_of_recordings(paths: Iterable[Path]) -> FeatureSettings:
    """Return what features recordings hold, the usual ones if none of this version; UsageError when they differ."""
    found: dict[FeatureSettings, Path] = {}
    for path in paths:
        for features in features_in(path):
            found.setdefault(features, path)
    if len(found) > 1:
        each = "; ".join(
            f"{path} holds {','.join(features.modalities)}" for features, path in found.items()
        )
        raise UsageError(
            f"the recordings hold different features ({each}): choose with --modalities"
        )
    return next(iter(found), FeatureSettings())


def features_in(path: Path) -> tuple[FeatureSettings, ...]:
    """Return the features in a recording that this version makes, by each episode's first readable observation."""
    found: dict[tuple[str, str], FeatureSettings | None] = {}
    try:
        for stored in messages_of(path, (OBSERVATION,)):
            ids = stored.robot, stored.episode
            if ids not in found:
                with suppress(ValueError):
                    found[ids] = _settings(cast("Observation", stored.message()))
    except RecordingError:
        return ()
    return tuple(dict.fromkeys(features for features in found.values() if features is not None))


def _settings(observation: Observation) -> FeatureSettings | None:
    """Return the settings that made an observation; None if it names no modalities, or this program's differ."""
    try:
        features = FeatureSettings.of(observation.modalities)
    except ValueError:
        return None
    return features if features.fingerprint == observation.fingerprint else None
