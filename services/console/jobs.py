"""What takes long, as a process of its own beside which driving goes on: ``smal learn``, ``smal world import``."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Final

from schemas.codec import printable
from services.console.folder import Folder
from services.kit.node import ServiceError

#: How much it gives way to the services of the stack; see nice(1).
_NICENESS: Final = 10
_COMMAND: Final = (sys.executable, "-c", "from services.cli.main import main; main()")
#: Lines of remarks that are kept.
_REMARKS: Final = 20
#: How long a command may say nothing, seconds. Learning tells of every hundredth of a stage. A map becomes a world
#: without a word: one of 40,000 houses that overlap took 13 s of processor time, and one of 64 MB, the most that is
#: taken, 43 s until it was refused for its 180,000 houses; on 2 cores with a load of 12 that was 70 and 116 s.
PATIENCE_S: Final = 600.0
#: How long a command that is told to end may tidy up; it does not hear that while it calculates something in one piece.
_ENDING_S: Final = 5.0
_log = logging.getLogger("console")


@dataclass(frozen=True)
class Job:
    """Something to make.

    Attributes
    ----------
    kind, name
        What it will be: a model, a world; and what it will be called.
    doing, done
        What the page says meanwhile, and when it is there.
    arguments
        Of the ``smal`` command, which is told ``--out`` as well.
    out
        The file that it writes.
    hidden
        Left out of what is told of it: where the files lie means nothing to who looks at the page.
    needs
        Where lies what the command reads: closed when it has ended.
    """

    kind: str
    name: str
    doing: str
    done: str
    arguments: tuple[str, ...]
    out: Path
    hidden: str
    needs: Folder | None = None


@dataclass(frozen=True)
class _Work:
    """A command at work, and what is heard of it: its lines, None when it has ended, and why it is to be ended."""

    process: subprocess.Popen[str]
    heard: SimpleQueue[str | _Ending | None] = field(default_factory=SimpleQueue)
    remarks: list[str] = field(default_factory=list)

    def listen(self) -> None:
        """Hear it to its end."""
        assert self.process.stdout is not None  # noqa: S101 - they are pipes
        assert self.process.stderr is not None  # noqa: S101
        remarking = threading.Thread(target=self.remarks.extend, args=(self.process.stderr,), daemon=True)
        remarking.start()
        for line in self.process.stdout:
            self.heard.put(line)
        remarking.join()
        self.process.wait()
        self.heard.put(None)


@dataclass(frozen=True)
class _Ending:
    """Why a command is ended before it is done."""

    outcome: str
    why: str = ""


class Jobs:
    """One job at a time.

    Parameters
    ----------
    show
        Called with the job as the page draws it, whenever that changes, on the job's thread.
    command
        What is run, before a job's arguments.
    patience_s
        How long it may say nothing.
    """

    def __init__(
        self,
        show: Callable[[dict[str, object]], None],
        command: Sequence[str] = _COMMAND,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._show = show
        self._command = command
        self._patience_s = patience_s
        self._work: _Work | None = None

    @property
    def running(self) -> bool:
        """Whether a job is at work."""
        return self._work is not None

    def begin(self, job: Job) -> None:
        """Begin a job.

        Raises
        ------
        ServiceError
            When another is at work, or what it makes is there already.
        """
        with ExitStack() as needs:
            if job.needs is not None:
                needs.enter_context(closing(job.needs))
            if self.running:
                raise ServiceError("something else is being made; wait, or cancel that first")
            if job.out.exists():
                raise ServiceError(f"there is a {job.kind} {job.name} already; choose another name")
            job.out.parent.mkdir(exist_ok=True)
            process = subprocess.Popen(  # noqa: S603 - our own command; the paths are of listed files
                [*self._command, *job.arguments, "--out", str(job.out)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # What it reads is in use for as long as it lives itself.
                pass_fds=() if job.needs is None else (job.needs.lock,),
                text=True,
                errors="replace",
            )
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
            self._work = work = _Work(process)
            threading.Thread(target=work.listen, name="job's listener", daemon=True).start()
            threading.Thread(target=self._follow, args=(job, work, needs.pop_all()), name="job", daemon=True).start()

    def cancel(self) -> None:
        """End the job that is at work, without what it makes."""
        if (work := self._work) is not None:
            work.heard.put(_Ending("cancelled"))
            work.process.terminate()

    def _follow(self, job: Job, work: _Work, needs: ExitStack) -> None:
        shown: dict[str, object] = {"kind": job.kind, "name": job.name, "doing": job.doing, "done": job.done}
        ending: _Ending | None = None
        try:
            with needs:
                ending = self._wait(work, shown)
        except Exception:  # noqa: BLE001 - whatever it is, the next one has its turn
            _log.warning("%s", job.doing, exc_info=True)
        work.process.kill()
        status = work.process.wait()
        said = [printable(line.strip()) for line in work.remarks]
        lines = [line.removeprefix("smal: ").replace(job.hidden, "") for line in said if line.startswith("smal: ")]
        if ending is None and status != 0:
            ending = _Ending("failed", (lines or said or [f"it ended with status {status}"])[-1])
        ending = ending or _Ending("done")
        self._work = None
        self._show({**shown, "outcome": ending.outcome, "why": ending.why, "remarks": lines[-_REMARKS:]})

    def _wait(self, work: _Work, shown: dict[str, object]) -> _Ending | None:
        """Show how far a command is until it has ended; return why it was made to."""
        self._show({**shown, "stage": "", "share": None})
        heard: str | _Ending | None = ""
        while isinstance(heard, str):
            try:
                told = json.loads(heard)
                self._show({**shown, "stage": told["stage"], "share": told["done"] / max(told["total"], 1)})
            except (ValueError, TypeError, KeyError):
                pass  # the summary, for people at a terminal
            try:
                heard = work.heard.get(timeout=self._patience_s)
            except Empty:
                heard = _Ending("failed", f"it has said nothing for {self._patience_s / 60:.0f} min, and was ended")
                work.process.terminate()
        if heard is not None:
            with suppress(subprocess.TimeoutExpired):
                work.process.wait(_ENDING_S)
        return heard
