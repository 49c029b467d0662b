"""Long tasks as child processes beside driving: ``smal learn``, ``smal world import``."""

import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, NamedTuple

from schemas.codec import printable
from services.kit.node import ServiceError

_NICENESS: Final = 10  # Niceness relative to the services of the stack; see nice(1).
_COMMAND: Final = (sys.executable, "-c", "from services.cli.main import main; main()")
# Number of output lines that are kept, and of remarks that are shown.
_LINES = 200
_REMARKS = 20
#: Timeout without output, seconds. Learning reports every percent of a stage. Map imports are
#: silent: 40,000 overlapping houses took 13 s of processor time, and a refused map of 64 MB (the
#: maximum, 180,000 houses) 43 s; with 2 cores at load 12 these took 70 and 116 s.
PATIENCE_S: Final = 600.0
_ENDING_S: Final = 5.0  # Time to clean up; commands ignore signals during a calculation.
_log = logging.getLogger("console")


@dataclass(frozen=True)
class BackgroundJob:
    """A long task with its command."""

    kind: str  # Kind of the result: a model or a world.
    name: str
    doing: str  # Text on the page during the job.
    done: str  # Text on the page after success.
    arguments: tuple[str, ...]  # Arguments of ``smal``, without ``--out``.
    out: Path
    hidden: str  # Path in the output, replaced by ``called`` on the page.
    called: str = ""
    renews: bool = False  # Whether the job updates an existing file.
    reads: IO[bytes] | None = None  # Open file without a name that the command reads.


class _Work:
    """A running command, with its outcome and reason if it was ended."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.ended: tuple[str, str] | None = None

    def lines(self) -> Iterator[str]:
        """Yield output lines until the command ends; end it after a timeout without output."""
        why = f"no output for {PATIENCE_S / 60:.0f} min, so it was ended"
        assert self.process.stdout is not None  # noqa: S101 - it is a pipe
        line = " "
        while line:
            silence = _later(PATIENCE_S, self.end, "failed", why)
            line = self.process.stdout.readline()
            silence.cancel()
            yield line.strip()

    def end(self, outcome: str, why: str = "") -> None:
        """Terminate the command, and kill it after a timeout."""
        self.ended = self.ended or (outcome, why)
        self.process.terminate()
        _later(_ENDING_S, self.process.kill)


class Jobs:
    """Runs one job at a time, for one thread.

    ``show`` receives the job's state for the page, on the job's own thread.
    """

    def __init__(self, show: Callable[[dict[str, object]], None]) -> None:
        self._show = show
        self._work: _Work | None = None

    @property
    def running(self) -> bool:
        """Whether a job is running."""
        return self._work is not None

    def begin(self, job: BackgroundJob) -> None:
        """Begin a job; raises ServiceError for a running job or an existing result."""
        if self.running:
            raise ServiceError("another job is running; wait, or cancel it first")
        if job.out.exists() and not job.renews:
            raise ServiceError(f"{job.kind} {job.name} already exists; choose another name")
        job.out.parent.mkdir(exist_ok=True)
        process = subprocess.Popen(  # noqa: S603 - our own command; the paths are of listed files
            [*_COMMAND, *job.arguments, "--out", str(job.out)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=() if job.reads is None else (job.reads.fileno(),),
            text=True,
            errors="replace",
        )
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        self._work = _Work(process)
        threading.Thread(
            target=self._follow, args=(job, self._work), name="job", daemon=True
        ).start()

    def cancel(self) -> None:
        """Cancel the running job and discard its result."""
        if (work := self._work) is not None:
            work.end("cancelled")

    def _follow(self, job: BackgroundJob, work: _Work) -> None:
        shown: dict[str, object] = {
            "kind": job.kind,
            "name": job.name,
            "doing": job.doing,
            "done": job.done,
        }
        output: deque[str] = deque(maxlen=_LINES)
        try:
            self._show({**shown, "stage": "", "share": None, "left_s": None})
            stage = ""
            began_s = 0.0
            for line in work.lines():
                if (progress := _progress(line)) is not None:
                    if progress.stage != stage:
                        stage = progress.stage
                        began_s = time.monotonic()
                    left_s = progress.left_s(time.monotonic() - began_s)
                    self._show({**shown, **progress._asdict(), "left_s": left_s})
                elif line:
                    output.append(printable(line).replace(job.hidden, job.called))
        except Exception:  # noqa: BLE001 - whatever it is, the next one has its turn
            _log.warning("%s", job.doing, exc_info=True)
            work.process.kill()
        status = work.process.wait()
        self._work = None
        remarks = [line.removeprefix("smal: ") for line in output if line.startswith("smal: ")]
        last = (remarks or [*output] or [f"exit status {status}"])[-1]
        outcome, why = work.ended or (("done", "") if status == 0 else ("failed", last))
        self._show({**shown, "outcome": outcome, "why": why, "remarks": remarks[-_REMARKS:]})


def _later(after_s: float, what: Callable[..., None], *arguments: object) -> threading.Timer:
    timer = threading.Timer(after_s, what, arguments)
    timer.daemon = True
    timer.start()
    return timer


class _Progress(NamedTuple):
    stage: str
    share: float

    def left_s(self, since_s: float) -> float | None:
        """Estimate the rest of a stage from its share; None before the first."""
        return round(since_s * (1.0 / self.share - 1.0), 1) if 0.0 < self.share < 1.0 else None


def _progress(line: str) -> _Progress | None:
    """Parse a progress line; None for other output."""
    try:
        progress = json.loads(line)
        return _Progress(progress["stage"], progress["done"] / max(progress["total"], 1))
    except (ValueError, TypeError, KeyError):
        return None
