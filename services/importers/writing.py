"""A drive as a recording like those of our own recorder, which ``smal learn`` takes without knowing its origin."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS, Message
from schemas.camera_info import CameraInfo
from schemas.command import CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.episode import Episode
from schemas.odometry import Odometry
from services.importers.atoms import Nominal, Thresholds, ahead_in_turns, atoms_of
from services.importers.drive import Array, Drive, Frame, ImportFailure, NotAnImage, Tally
from services.importers.images import size_of
from services.importers.resample import TICK_S, Moves, odometry, ticks
from services.recordings.writer import EpisodeWriter

#: Of poses: a micrometre and a microradian.
_DIGITS: Final = 6
_STOP: Final = ATOMS.index("stop")


@dataclass(frozen=True)
class Purpose:
    """What a drive is for.

    Parameters
    ----------
    robot, goal
        Its name, and that of the place it leads to.
    world
        What stands for the world: the format.
    success
        Whether drives reached the goal where the source does not say; None to take its word, or else a success.
    reckon
        Whether to reckon a way from velocities where there is no odometry.
    from_s, to_s
        Which part of each drive.
    focal
        Focal length over the image's width, which goes before the source's own.
    """

    robot: str
    goal: str
    world: str
    success: bool | None
    reckon: bool
    from_s: float
    to_s: float
    focal: float | None


@dataclass(frozen=True, eq=False)
class Written:
    """What became of a drive."""

    path: Path
    ticks: int
    atoms: NDArray[np.int8]
    with_odometry: bool
    success: bool


@dataclass(frozen=True, eq=False)
class _Spool:
    """The images of a drive, on the disk until it is known what was done at each."""

    file: IO[bytes]
    numbers: list[int]
    ends: list[int]
    start_s: float

    def images(self) -> Iterator[bytes]:
        """Yield them in their order."""
        self.file.seek(0)
        for begin, end in zip([0, *self.ends[:-1]], self.ends, strict=True):
            yield self.file.read(end - begin)

    @property
    def times_s(self) -> Array:
        """Times of their ticks."""
        return self.start_s + TICK_S * np.array(self.numbers)


def write(
    folder: Path,
    drive: Drive,
    purpose: Purpose,
    usual: Nominal,
    thresholds: Thresholds,
    tally: Tally,
    progress: Callable[[int], None],
) -> Written | None:
    """Write the recording of a drive.

    Returns
    -------
    Written or None
        None where nothing of the drive can be used; the tally says why.

    Raises
    ------
    ImportFailure
        When the source is damaged there.
    OSError
        When it cannot be written.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        spool = _spooled(file, drive, purpose, tally, progress)
        if len(spool.numbers) < 2:
            tally.count("drives have less than two usable frames and are left out")
            return None
        moves = Moves(drive.motion)
        tally.count("ticks lack a velocity; the robot is taken to stand", moves.silent(spool.times_s))
        velocities = moves.velocities(spool.times_s)
        atoms = atoms_of(velocities, usual, thresholds)
        ahead = ahead_in_turns(velocities, atoms, usual)
        way = odometry(drive, spool.times_s, moves if purpose.reckon else None)
        success = drive.success if drive.success is not None else True
        success = success if purpose.success is None else purpose.success
        path = _recorded(folder, drive, purpose, spool, (atoms, ahead), way, success)
    return Written(path, len(spool.numbers), atoms, way is not None, success)


def _spooled(file: IO[bytes], drive: Drive, purpose: Purpose, tally: Tally, progress: Callable[[int], None]) -> _Spool:
    numbers: list[int] = []
    ends: list[int] = []
    start_s = 0.0
    for tick in ticks(_counted(drive, progress), purpose.from_s, purpose.to_s, tally):
        if tick.number == 0:
            start_s = tick.frame.time_s
        try:
            jpeg = tick.frame.jpeg()
        except NotAnImage as error:
            tally.count(str(error))
            continue
        file.write(jpeg)
        numbers.append(tick.number)
        ends.append(file.tell())
    return _Spool(file, numbers, ends, start_s)


def _counted(drive: Drive, progress: Callable[[int], None]) -> Iterator[Frame]:
    for frame in drive.frames():
        progress(1)
        yield frame


def _recorded(
    folder: Path,
    drive: Drive,
    purpose: Purpose,
    spool: _Spool,
    made: tuple[NDArray[np.int8], Array],
    way: tuple[Array, NDArray[np.bool_]] | None,
    success: bool,
) -> Path:
    name = _episode_name(drive, spool)

    def header(tick: int) -> Message:
        stamp_ns = round((max(spool.start_s, 0.0) + TICK_S * tick) * 1e9)
        return Message(robot=purpose.robot, episode=name, tick=tick, stamp_ns=stamp_ns)

    told = {"purpose": "drive", "driver": "teleop", "world": purpose.world, "seed": 0, "goal": purpose.goal}
    first, last = header(spool.numbers[0]), header(spool.numbers[-1])
    writer = EpisodeWriter.begin(folder, Episode.after(first, event="started", **told))
    writer.write(Episode.after(first, event="started", **told))
    focal = purpose.focal or drive.focal
    for row, (number, jpeg) in enumerate(zip(spool.numbers, spool.images(), strict=True)):
        cause = header(number)
        width, height = size_of(jpeg)
        writer.write(CompressedImage.after(cause, width=width, height=height, data=jpeg))
        if row == 0 and focal is not None:
            writer.write(_camera_info(cause, width, height, focal))
        if way is not None and way[1][row]:
            writer.write(_pose(cause, way[0], row, spool))
        writer.write(_applied(cause, int(made[0][row]), float(made[1][row])))
    ended = {"outcome": "found", "judge": "operator"} if success else {"outcome": "aborted"}
    writer.write(Episode.after(last, event="ended", **told, **ended))
    path = writer.seal()
    if writer.problem is not None:
        raise ImportFailure(f"{path}: cannot be written: {writer.problem}")
    return path


def _episode_name(drive: Drive, spool: _Spool) -> str:
    """Name an episode by its drive and what is in it: imported twice it is known again, and another one is another."""
    digest = hashlib.sha256(f"{spool.start_s!r} {spool.numbers} {spool.ends}".encode())
    for part in (drive.motion.times_s, drive.motion.linear, drive.motion.angular):
        digest.update(part.tobytes())
    plain = re.sub(r"[^a-z0-9]+", "-", drive.name.lower()).strip("-")[:32]
    return f"{plain or 'drive'}-{digest.hexdigest()[:12]}"


def _camera_info(cause: Message, width: int, height: int, focal: float) -> CameraInfo:
    return CameraInfo.after(
        cause, width=width, height=height, focal_px=focal * width, centre_x_px=width / 2, centre_y_px=height / 2
    )


def _pose(cause: Message, poses: Array, row: int, spool: _Spool) -> Odometry:
    x, y, heading = poses[row].tolist()
    speed, rate = 0.0, 0.0
    if row:
        passed_s = TICK_S * (spool.numbers[row] - spool.numbers[row - 1])
        moved = poses[row] - poses[row - 1]
        speed = float(moved[0] * np.cos(heading) + moved[1] * np.sin(heading)) / passed_s
        rate = float(np.arctan2(np.sin(moved[2]), np.cos(moved[2]))) / passed_s
    return Odometry.after(
        cause,
        x_m=round(x, _DIGITS),
        y_m=round(y, _DIGITS),
        heading_rad=round(float(np.arctan2(np.sin(heading), np.cos(heading))), _DIGITS),
        speed_m_s=round(speed, _DIGITS),
        turn_rate_rad_s=round(rate, _DIGITS),
    )


def _applied(cause: Message, atom: int, ahead: float) -> CommandApplied:
    speed = 0.0 if atom == _STOP else 1.0
    return CommandApplied.after(
        cause, atom=ATOMS[atom], speed=speed, ahead=round(ahead, _DIGITS), source="teleop", reason="command"
    )
