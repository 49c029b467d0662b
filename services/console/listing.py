"""Recordings as the page lists them, read in a process of its own: a file that takes long, or all memory, ends that."""

import logging
import multiprocessing
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, cast

from schemas.codec import printable
from schemas.topics import APPLIED, JPEG
from services.kit.jpeg import encode_jpeg, shrunk
from services.recordings.dataset import unusable
from services.recordings.encoding import decode_image
from services.recordings.reader import read_recording
from services.recordings.recorded import RecordedEpisode
from services.recordings.stream import RecordingError
from services.robot.clock import TICK_S

# Pictures along a drive, and their width; six of them fill a row of the list.
THUMBNAILS = 6
_WIDTH = 160
#: Processor time that one file may take, whole seconds: a drive of 4 hours takes 15 of them. Wall time would count what
#: else the machine does.
READ_S: Final = 120
_NICENESS: Final = 10  # How much reading gives way to the services of the stack; see nice(1).
_ENDED_FIRST: Final = (
    "1000"  # Where memory runs out, this process ends before the others; see proc(5).
)
_SAME: Final = (
    "episode",
    "purpose",
    "goal",
    "world",
    "outcome",
    "frames",
)  # Of a recorded episode, and as listed.
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
    outcome: str | None = None
    corrected: bool = (
        False  # Whether a person took over from the robot that drove by itself, and so taught it.
    )
    frames: int = 0
    seconds: float = 0.0
    useless: str = ""  # Why it teaches nothing; empty where it does.
    thumbnails: tuple[bytes, ...] = ()


class Reader:
    """Reads recordings, one at a time, in a process of its own; of one thread, but for ``stop``."""

    def __init__(self) -> None:
        self._process: tuple[multiprocessing.process.BaseProcess, Connection] | None = None

    def read(self, path: Path, listed: ListedRecording) -> ListedRecording:
        """Complete what the page lists with what is in the file; where it cannot be read, with why not."""
        process, ours = self._process = self._process or _started()
        with suppress(EOFError, OSError):
            ours.send((path, listed))
            return cast("ListedRecording", ours.recv())
        self.close()
        too_long = process.exitcode == -signal.SIGXCPU
        why = f"it takes more than {READ_S} s" if too_long else "the process that read it has died"
        return replace(listed, useless=f"it cannot be read: {why}")

    def stop(self) -> None:
        """Have what is being read end, from any thread."""
        if (at_work := self._process) is not None:
            at_work[0].kill()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            process, ours = self._process
            self._process = None
            ours.close()
            process.join()  # it ends where nobody asks any more


def _started() -> tuple[multiprocessing.process.BaseProcess, Connection]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_read_all, args=(theirs,), name="recordings", daemon=True)
    process.start()
    theirs.close()  # so that its death is heard
    return process, ours


def _read_all(connection: Connection) -> None:
    os.nice(_NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started it
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_ENDED_FIRST)
    with suppress(EOFError, OSError):
        while True:
            path, listed = connection.recv()
            end_after(READ_S)
            connection.send(read(path, listed))


def end_after(limit_s: int) -> None:
    """Have the system end this process (SIGXCPU) when it has worked for so many seconds more."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    until_s = int(spent.ru_utime + spent.ru_stime) + limit_s
    resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.RLIM_INFINITY))


def read(path: Path, listed: ListedRecording) -> ListedRecording:
    """Complete what the page lists with what is in the file."""
    try:
        episode, *others = read_recording(path, topics=(JPEG, APPLIED)).episodes
    except RecordingError as error:
        return replace(listed, useless=printable(str(error)).removeprefix(f"{path}: "))
    useless = (
        "it holds several episodes; use smal learn"
        if others
        else unusable(episode, include_runs=True)
    )
    by_hand = any(
        one.source == "teleop" or one.reason == "taken_over" for one in episode.applied.values()
    )
    ticks = sorted(episode.images)
    same: dict[str, Any] = {name: getattr(episode, name) for name in _SAME}
    return replace(
        listed,
        corrected=episode.purpose == "run" and by_hand,
        seconds=(ticks[-1] - ticks[0]) * TICK_S if ticks else 0.0,
        useless=useless or "",
        thumbnails=tuple(_thumbnails(episode, ticks)),
        **same,
    )


def _thumbnails(episode: RecordedEpisode, ticks: list[int]) -> Iterator[bytes]:
    count = min(THUMBNAILS, len(ticks))
    for k in range(count):
        tick = ticks[round(k * (len(ticks) - 1) / max(count - 1, 1))]
        try:
            yield encode_jpeg(shrunk(decode_image(bytes(episode.images[tick])), _WIDTH))
        except ValueError as error:
            _log.warning("%s, frame %d: %s", episode.episode, tick, error)
