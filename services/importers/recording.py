"""A drive as a recording like those of our own recorder, which ``smal learn`` takes without knowing its origin."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Odometry
from services.importers.drive import Array, ImportedDrive, ImportFailure, NotAnImage, Tally
from services.importers.job import ImportJob
from services.importers.ticks import TICK_S, Moves, Nominal, Ticks, odometry, shares_of, ticks
from services.kit.cameras import camera_info
from services.kit.jpeg import jpeg_size
from services.recordings.writer import EpisodeWriter
from smal.camera import Camera
from smal.movement import wrapped

_DIGITS: Final = 6  # Of poses: a micrometre and a microradian.
_LEAST_FRAMES: Final = 2
_POSE: Final = ("x_m", "y_m", "heading_rad", "speed_m_s", "turn_rate_rad_s")


class Written(NamedTuple):
    """What became of a drive; how many ticks there are of each atom."""

    path: Path
    atoms: Counter[str]
    with_odometry: bool
    success: bool


def write(
    drive: ImportedDrive, job: ImportJob, usual: Nominal, tally: Tally, advance: Callable[[], None]
) -> Written | None:
    """Write a drive's recording, ``advance`` for each frame; None: of no use. After an error nothing is left."""
    shown = ticks(drive.times_s, job.from_s, job.to_s, tally)
    images = _images(drive, shown, tally, advance)
    begin = list(islice(images, _LEAST_FRAMES))
    if len(begin) < _LEAST_FRAMES:
        tally.count("drives have less than two usable frames and are left out")
        return None
    moves = Moves(drive.motion)
    tally.count("ticks lack a velocity; the robot is taken to stand", moves.silent(shown.times_s))
    shares = shares_of(moves.velocities(shown.times_s), usual)
    poses = _poses(drive, shown.times_s, moves if job.reckon and drive.metric else None)
    success = drive.success is not False if job.success is None else job.success
    name = _name(drive, shown, begin[0][1])
    told = {
        "purpose": "drive",
        "driver": "teleop",
        "world": job.format,
        "seed": 0,
        "goal": job.goal,
    }

    def header(row: int) -> Message:
        tick = int(shown.numbers[row])
        stamp_ns = round((max(shown.start_s, 0.0) + TICK_S * tick) * 1e9)
        return Message(robot=job.robot, episode=name, tick=tick, stamp_ns=stamp_ns)

    cause = header(begin[0][0])
    started = Episode.after(cause, event="started", **told)
    writer = EpisodeWriter.begin(Path(job.folder), started)
    camera = (
        drive.camera if job.field_of_view_deg is None else Camera.of_field(job.field_of_view_deg)
    )
    made: Counter[str] = Counter()
    try:
        writer.write(started)
        for row, jpeg in chain(begin, images):
            cause = header(row)
            atom = shares[row].atom(job.still, job.turning)
            width, height = jpeg_size(jpeg) or (0, 0)
            writer.write(CompressedImage.after(cause, width=width, height=height, data=jpeg))
            if camera is not None and not made:
                writer.write(camera_info(cause, camera, width, height))
            if poses is not None and not np.isnan(poses[row, 0]):
                where = dict(zip(_POSE, poses[row].round(_DIGITS).tolist(), strict=True))
                writer.write(Odometry.after(cause, **where))
            done = shares[row]._asdict() | {"atom": atom, "source": "teleop", "reason": "command"}
            writer.write(CommandApplied.after(cause, **done))
            made[atom] += 1
        ended = {"outcome": "found", "judge": "operator"} if success else {"outcome": "aborted"}
        writer.write(Episode.after(cause, event="ended", **told, **ended))
    except BaseException:
        writer.seal().unlink(missing_ok=True)
        raise
    path = writer.seal()
    if writer.problem is not None:
        raise ImportFailure(f"{path}: cannot be written: {writer.problem}")
    return Written(path, made, poses is not None, success)


def _images(
    drive: ImportedDrive, shown: Ticks, tally: Tally, advance: Callable[[], None]
) -> Iterator[tuple[int, bytes]]:
    """Yield each row of the ticks and its JPEG; those whose frame is no image are left out."""
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
    """Return what odometry says at each tick, (n, 5), NaN where it is not known; None where it never is."""
    way = odometry(drive, times_s, moves)
    if way is None:
        return None
    poses, known = way
    moved = np.diff(poses, axis=0, prepend=poses[:1])
    passed_s = np.diff(times_s, prepend=times_s[0] - TICK_S)
    heading = wrapped(poses[:, 2])
    speed = (moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)) / passed_s
    told = np.column_stack([poses[:, :2], heading, speed, wrapped(moved[:, 2]) / passed_s])
    return np.asarray(np.where(known[:, None], told, np.nan), dtype=np.float64)


def _name(drive: ImportedDrive, shown: Ticks, first: bytes) -> str:
    """Name an episode by its drive and what is in it: imported twice it is known again, and another one is another."""
    digest = hashlib.sha256(first)
    for part in (shown.numbers, drive.times_s[shown.frames], drive.motion):
        digest.update(part.tobytes())
    plain = re.sub(r"[^a-z0-9]+", "-", drive.name.lower()).strip("-")[:32]
    return f"{plain or 'drive'}-{digest.hexdigest()[:12]}"
