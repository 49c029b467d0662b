"""Read recordings for the page in a child process, with limits against slow and large files."""

import logging
import multiprocessing
import os
import resource
import signal
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from schemas.codec import printable
from schemas.episode import Outcome, in_words
from schemas.motion import Odometry, TruePose
from schemas.topics import APPLIED, JPEG, ODOMETRY, POSE
from services.console.driven_route import DrivenRoute
from services.kit.jpeg import encode_jpeg, shrunk
from services.recordings.dataset import unusable
from services.recordings.encoding import decode_image
from services.recordings.reader import read_recording
from services.recordings.recorded import RecordedEpisode
from services.recordings.stream import RecordingError

# Number of pictures along a drive, and their width; six fill a row of the list.
THUMBNAILS = 6
_WIDTH = 160
# Number of pictures of a replayed run, and their width.
_MOMENTS: Final = 60
_MOMENT_WIDTH: Final = 320
#: Limit of processor time for a file, seconds: a drive of 4 hours takes 15 s. Wall time would
#: include other load.
READ_S: Final = 120
_NICENESS: Final = 10  # Niceness relative to the services of the stack; see nice(1).
# The kernel ends this process first when memory runs out; see proc(5).
_ENDED_FIRST: Final = "1000"
# Fields with equal names in `RecordedEpisode` and `ListedRecording`.
_SAME: Final = ("episode", "purpose", "goal", "world", "outcome", "frames")
_log = logging.getLogger("console")


@dataclass(frozen=True)
class ListedRecording:
    """A recording as the page lists it; ``thumbnails`` are JPEG, along the drive."""

    name: str
    when_s: float
    size: int
    episode: str = ""
    purpose: str | None = None
    goal: str = ""
    world: str = ""
    outcome: Outcome | None = None
    # Whether a person took over during a run, which makes the run a lesson.
    corrected: bool = False
    kidnapped: int = 0  # How often the robot was moved elsewhere.
    frames: int = 0
    seconds: float = 0.0
    useless: str = ""  # Reason why it cannot teach; empty if it can.
    thumbnails: tuple[bytes, ...] = ()
    # Driven path in metres, in the world's frame if the robot publishes its true poses, else by
    # odometry, and its length by odometry. A kidnapping ends a piece of the path.
    path: tuple[tuple[tuple[float, float], ...], ...] = ()
    metres: float = 0.0

    def shown(self) -> dict[str, object]:
        """Return the entry for the page: outcome in words, number of thumbnails, and no path."""
        shown = {name: value for name, value in vars(self).items() if name != "path"}
        return shown | {"thumbnails": len(self.thumbnails), "result": in_words(self.outcome)}


class RecordedMoment(NamedTuple):
    """A moment of a recorded episode, with its picture as JPEG."""

    seconds: float
    pose: tuple[float, float, float] | None  # Metres and radians.
    picture: bytes


@dataclass(frozen=True)
class RecordedMoments:
    """Moments along an episode; ``true``: in the frame of the world, else of its odometry."""

    true: bool = False
    moments: tuple[RecordedMoment, ...] = ()


class Reader:
    """Reads recordings one at a time in a child process, for one thread (except ``stop``)."""

    def __init__(self) -> None:
        self._process: tuple[multiprocessing.process.BaseProcess, Connection] | None = None

    def read(self, path: Path, listed: ListedRecording) -> ListedRecording:
        """Return the entry with the content of the file, or with the reason of a failure."""
        try:
            return cast("ListedRecording", self._call(read, path, listed))
        except RecordingError as error:
            return replace(listed, useless=str(error))

    def moments(self, path: Path) -> RecordedMoments:
        """Return moments along the recorded episode; RecordingError if it cannot be read."""
        return cast("RecordedMoments", self._call(read_moments, path))

    def _call(self, function: Callable[..., object], *arguments: object) -> object:
        process, ours = self._process = self._process or _started()
        with suppress(EOFError, OSError):
            ours.send((function, arguments))
            return ours.recv()
        self.close()
        too_long = process.exitcode == -signal.SIGXCPU
        why = f"it takes more than {READ_S} s" if too_long else "the reading process has died"
        raise RecordingError(f"cannot be read: {why}")

    def stop(self) -> None:
        """End the current reading, from any thread."""
        if (at_work := self._process) is not None:
            at_work[0].kill()

    def close(self) -> None:
        """End the child process."""
        if self._process is not None:
            process, ours = self._process
            self._process = None
            ours.close()
            process.join()  # It ends without its connection.


def _started() -> tuple[multiprocessing.process.BaseProcess, Connection]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_read_all, args=(theirs,), name="recordings", daemon=True)
    process.start()
    theirs.close()  # So that the death of the child ends the connection.
    return process, ours


def _read_all(connection: Connection) -> None:
    os.nice(_NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent.
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_ENDED_FIRST)
    with suppress(EOFError, OSError):
        while True:
            function, arguments = connection.recv()
            end_after(READ_S)
            connection.send(function(*arguments))


def end_after(limit_s: int) -> None:
    """Limit the further processor time of this process, seconds (SIGXCPU)."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    until_s = int(spent.ru_utime + spent.ru_stime) + limit_s
    resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.RLIM_INFINITY))


def read(path: Path, listed: ListedRecording) -> ListedRecording:
    """Return the entry with the content of the file."""
    try:
        episode, *others = read_recording(path, topics=(JPEG, APPLIED, ODOMETRY, POSE)).episodes
    except RecordingError as error:
        return replace(listed, useless=printable(str(error)).removeprefix(f"{path}: "))
    useless = (
        "contains several episodes; use smal learn"
        if others
        else unusable(episode, include_runs=True)
    )
    by_hand = any(
        one.source == "teleop" or one.reason == "taken_over" for one in episode.applied.values()
    )
    driven = _route(episode.odometry)
    same: dict[str, Any] = {name: getattr(episode, name) for name in _SAME}
    return replace(
        listed,
        corrected=episode.purpose == "run" and by_hand,
        kidnapped=len(episode.kidnapped),
        seconds=episode.seconds(max(episode.images)) if episode.images else 0.0,
        useless=useless or "",
        thumbnails=tuple(jpeg for _, jpeg in _pictures(episode, THUMBNAILS, _WIDTH)),
        path=_pieces(episode),
        metres=driven.metres,
        **same,
    )


def _pieces(episode: RecordedEpisode) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Return the pieces of the driven path between kidnappings."""
    poses = episode.poses or episode.odometry
    carried = sorted(episode.kidnapped)
    pieces = groupby(sorted(poses), key=lambda tick: bisect_right(carried, tick))
    return tuple(tuple(_route({tick: poses[tick] for tick in ticks}).points) for _, ticks in pieces)


def _route(poses: Mapping[int, Odometry | TruePose]) -> DrivenRoute:
    route = DrivenRoute()
    for tick in sorted(poses):
        route.add(poses[tick].x_m, poses[tick].y_m)
    return route


def read_moments(path: Path) -> RecordedMoments:
    """Return moments along the episode of a file; empty without a readable episode."""
    try:
        episode, *_ = read_recording(path, topics=(JPEG, ODOMETRY, POSE)).episodes
    except RecordingError:
        return RecordedMoments()
    poses = episode.poses or episode.odometry
    moments = tuple(
        RecordedMoment(episode.seconds(tick), poses[tick].pose if tick in poses else None, jpeg)
        for tick, jpeg in _pictures(episode, _MOMENTS, _MOMENT_WIDTH)
    )
    return RecordedMoments(bool(episode.poses), moments)


def _pictures(episode: RecordedEpisode, most: int, width: int) -> Iterator[tuple[int, bytes]]:
    """Yield pictures along an episode with their ticks; damaged pictures are left out."""
    ticks = sorted(episode.images)
    count = min(most, len(ticks))
    for k in range(count):
        tick = ticks[round(k * (len(ticks) - 1) / max(count - 1, 1))]
        try:
            yield tick, encode_jpeg(shrunk(decode_image(bytes(episode.images[tick])), width))
        except ValueError as error:
            _log.warning("%s, frame %d: %s", episode.episode, tick, error)
