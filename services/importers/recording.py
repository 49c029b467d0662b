"""Writer of foreign drives as recordings like those of our own recorder."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.base import TICK_S, Message
from schemas.camera import CompressedImage
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Odometry
from services.importers.drive import POSE, Array, ImportedDrive, ImportFailure, NotAnImage, Tally
from services.importers.job import ImportJob
from services.importers.ticks import Moves, Nominal, Ticks, odometry, shares_of, ticks
from services.kit.cameras import camera_info
from services.kit.jpeg import jpeg_size
from services.recordings.writer import EpisodeWriter
from smal.camera import Camera
from smal.movement import wrapped

_DIGITS: Final = 6  # Decimals of poses: a micrometre and a microradian.
_LEAST_FRAMES: Final = 2
_ODOMETRY: Final = (*POSE, "speed_m_s", "turn_rate_rad_s")


class Written(NamedTuple):
    """Recording of a drive, and its number of ticks by action."""

    path: Path
    atoms: Counter[str]
    with_odometry: bool
    success: bool
    camera: Camera | None


def write(
    drive: ImportedDrive, job: ImportJob, usual: Nominal, tally: Tally, advance: Callable[[], None]
) -> Written | None:
    """Write the recording of a drive; return None if the drive has fewer than two frames.

    ``advance`` is called for each frame. An error leaves no file behind.
    """
    shown = ticks(drive.times_s, job.from_s, job.to_s, tally)
    images = _images(drive, shown, tally, advance)
    begin = list(islice(images, _LEAST_FRAMES))
    if len(begin) < _LEAST_FRAMES:
        tally.count("drives have fewer than two usable frames (left out)")
        return None
    first, jpeg = begin[0]
    episode = _Episode(drive, job, shown, usual, _name(drive, shown, jpeg))
    tally.count("ticks lack a velocity (counted as standing)", episode.silent)
    started = episode.event(first, event="started")
    writer = EpisodeWriter.begin(Path(job.folder), started)
    try:
        writer.write(started)
        for message in episode.messages(chain(begin, images)):
            writer.write(message)
    except BaseException:
        writer.seal().unlink(missing_ok=True)
        raise
    path = writer.seal()
    if writer.problem is not None:
        raise ImportFailure(f"{path}: cannot be written: {writer.problem}")
    return Written(path, episode.atoms, episode.poses is not None, episode.success, episode.camera)


class _Episode:
    """The messages of a drive, as a robot publishes them."""

    def __init__(
        self, drive: ImportedDrive, job: ImportJob, shown: Ticks, usual: Nominal, name: str
    ) -> None:
        moves = Moves(drive.motion)
        self.atoms: Counter[str] = Counter()
        self.silent = moves.silent(shown.times_s)
        self.success = drive.success is not False if job.success is None else job.success
        self.poses = _poses(drive, shown.times_s, moves if job.reckon and drive.metric else None)
        self._shares = shares_of(moves.velocities(shown.times_s), usual)
        field_deg = job.field_of_view_deg
        self.camera = drive.camera if field_deg is None else Camera.of_field(field_deg)
        self._job = job
        self._shown = shown
        self._name = name

    def event(self, row: int, **fields: str) -> Episode:
        """Return an event of the episode at a row of its ticks."""
        same = {"purpose": "drive", "driver": "teleop", "world": self._job.format}
        same |= {"goal": self._job.goal}
        return Episode.after(self._header(row), seed=0, **same, **fields)

    def messages(self, images: Iterable[tuple[int, bytes]]) -> Iterator[Message]:
        """Yield the messages of all frames, then the end."""
        row = 0
        for row, jpeg in images:
            yield from self._frame(row, jpeg)
        ended = (
            {"outcome": "found", "judge": "operator"} if self.success else {"outcome": "aborted"}
        )
        yield self.event(row, event="ended", **ended)

    def _frame(self, row: int, jpeg: bytes) -> Iterator[Message]:
        cause = self._header(row)
        width, height = jpeg_size(jpeg) or (0, 0)
        yield CompressedImage.after(cause, width=width, height=height, data=jpeg)
        if self.camera is not None and not self.atoms:
            yield camera_info(cause, self.camera, width, height)
        if self.poses is not None and not np.isnan(self.poses[row, 0]):
            pose = self.poses[row].round(_DIGITS).tolist()
            yield Odometry.after(cause, **dict(zip(_ODOMETRY, pose, strict=True)))
        share = self._shares[row]
        atom = share.atom(self._job.still, self._job.turning)
        self.atoms[atom] += 1
        done = share._asdict() | {"atom": atom, "source": "teleop", "reason": "command"}
        yield CommandApplied.after(cause, **done)

    def _header(self, row: int) -> Message:
        tick = int(self._shown.numbers[row])
        stamp_ns = round((max(self._shown.start_s, 0.0) + TICK_S * tick) * 1e9)
        return Message(robot=self._job.robot, episode=self._name, tick=tick, stamp_ns=stamp_ns)


def _images(
    drive: ImportedDrive,
    shown: Ticks,
    tally: Tally,
    advance: Callable[[], None],
) -> Iterator[tuple[int, bytes]]:
    """Yield each row of the ticks with its JPEG, except unusable frames."""
    rows = np.searchsorted(shown.frames, np.arange(drive.times_s.size + 1)).tolist()
    for frame, image in enumerate(drive.images()):
        advance()
        if rows[frame] == rows[frame + 1]:
            continue
        try:
            jpeg = image()
        except NotAnImage as error:
            tally.count(str(error))
            continue
        yield from ((row, jpeg) for row in range(rows[frame], rows[frame + 1]))


def _poses(drive: ImportedDrive, times_s: Array, moves: Moves | None) -> Array | None:
    """Return the odometry of each tick, (n, 5), NaN if unknown; None if always unknown."""
    way = odometry(drive, times_s, moves)
    if way is None:
        return None
    poses, known = way
    moved = np.diff(poses, axis=0, prepend=poses[:1])
    passed_s = np.diff(times_s, prepend=times_s[0] - TICK_S)
    heading = wrapped(poses[:, 2])
    speed = (moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)) / passed_s
    states = np.column_stack([poses[:, :2], heading, speed, wrapped(moved[:, 2]) / passed_s])
    return np.asarray(np.where(known[:, None], states, np.nan), dtype=np.float64)


def _name(drive: ImportedDrive, shown: Ticks, first: bytes) -> str:
    """Name an episode by its content, so that a drive imported twice gets the same name."""
    digest = hashlib.sha256(first)
    for part in (shown.numbers, drive.times_s[shown.frames], drive.motion):
        digest.update(part.tobytes())
    plain = re.sub(r"[^a-z0-9]+", "-", drive.name.lower()).strip("-")[:32]
    return f"{plain or 'drive'}-{digest.hexdigest()[:12]}"
