"""What takes long, as a process of its own beside which driving goes on: ``smal learn``, ``smal world import``."""

import json
import logging
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from schemas.codec import printable
from services.kit.node import ServiceError

_NICENESS: Final = 10  # How much it gives way to the services of the stack; see nice(1).
_COMMAND: Final = (sys.executable, "-c", "from services.cli.main import main; main()")
# Lines that are kept of what a command says, and of those the remarks that are shown.
_LINES = 200
_REMARKS = 20
#: How long a command may say nothing, seconds. Learning tells of every hundredth of a stage. A map becomes a world
#: without a word: one of 40,000 houses that overlap took 13 s of processor time, and one of 64 MB, the most that is
#: taken, 43 s until it was refused for its 180,000 houses; on 2 cores with a load of 12 that was 70 and 116 s.
PATIENCE_S: Final = 600.0
_ENDING_S: Final = 5.0  # How long a command may tidy up; it is not heard amid a calculation.
_log = logging.getLogger("console")


@dataclass(frozen=True)
class BackgroundJob:
    """Something to make."""

    kind: str  # What it will be: a model, a world.
    name: str
    doing: str  # What the page says meanwhile.
    done: str  # What the page says when it is there.
    arguments: tuple[str, ...]  # Of the ``smal`` command, which is told ``--out`` as well.
    out: Path
    hidden: str  # How the command names what it reads, which is ``called`` otherwise on the page.
    called: str = ""
    renews: bool = False  # Whether it is there already.
    reads: IO[bytes] | None = None  # The open file that the command reads, where it has no name.


class _Work:
    """A command at work, and how it was ended, if it was: the outcome, and why."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.ended: tuple[str, str] | None = None

    def lines(self) -> Iterator[str]:
        """Give what it says until it ends; it is ended where it says nothing for too long."""
        why = f"it said nothing for {PATIENCE_S / 60:.0f} min, and was ended"
        assert self.process.stdout is not None  # noqa: S101 - it is a pipe
        line = " "
        while line:
            silence = _later(PATIENCE_S, self.end, "failed", why)
            line = self.process.stdout.readline()
            silence.cancel()
            yield line.strip()

    def end(self, outcome: str, why: str = "") -> None:
        """End it: it may tidy up, for a while."""
        self.ended = self.ended or (outcome, why)
        self.process.terminate()
        _later(_ENDING_S, self.process.kill)


class Jobs:
    """One job at a time, of one thread; ``show`` is given the job as the page draws it, on the job's own thread."""

    def __init__(self, show: Callable[[dict[str, object]], None]) -> None:
        self._show = show
        self._work: _Work | None = None

    @property
    def running(self) -> bool:
        """Whether a job is at work."""
        return self._work is not None

    def begin(self, job: BackgroundJob) -> None:
        """Begin a job; ServiceError when another is at work, or what it makes is there already."""
        if self.running:
            raise ServiceError("something else is being made; wait, or cancel that first")
        if job.out.exists() and not job.renews:
            raise ServiceError(f"there is a {job.kind} {job.name} already; choose another name")
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
        """End the job that is at work, without what it makes."""
        if (work := self._work) is not None:
            work.end("cancelled")

    def _follow(self, job: BackgroundJob, work: _Work) -> None:
        shown: dict[str, object] = {
            "kind": job.kind,
            "name": job.name,
            "doing": job.doing,
            "done": job.done,
        }
        said: deque[str] = deque(maxlen=_LINES)
        try:
            self._show({**shown, "stage": "", "share": None})
            for line in work.lines():
                if (progress := _progress(line)) is not None:
                    self._show({**shown, **progress})
                elif line:
                    said.append(printable(line).replace(job.hidden, job.called))
        except Exception:  # noqa: BLE001 - whatever it is, the next one has its turn
            _log.warning("%s", job.doing, exc_info=True)
            work.process.kill()
        status = work.process.wait()
        self._work = None
        remarks = [line.removeprefix("smal: ") for line in said if line.startswith("smal: ")]
        last = (remarks or [*said] or [f"it ended with status {status}"])[-1]
        outcome, why = work.ended or (("done", "") if status == 0 else ("failed", last))
        self._show({**shown, "outcome": outcome, "why": why, "remarks": remarks[-_REMARKS:]})


def _later(after_s: float, what: Callable[..., None], *arguments: object) -> threading.Timer:
    timer = threading.Timer(after_s, what, arguments)
    timer.daemon = True
    timer.start()
    return timer


def _progress(line: str) -> dict[str, object] | None:
    """Return how far a command says that it is; None where the line is for people."""
    try:
        told = json.loads(line)
        return {"stage": told["stage"], "share": told["done"] / max(told["total"], 1)}
    except (ValueError, TypeError, KeyError):
        return None
