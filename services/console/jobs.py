"""What takes long, as a process of its own beside which driving goes on: ``smal learn``, ``smal world import``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from schemas.codec import printable
from services.kit.node import ServiceError

#: How much it gives way to the services of the stack; see nice(1).
_NICENESS: Final = 10
_COMMAND: Final = (sys.executable, "-c", "from services.cli.main import main; main()")
#: Lines of remarks that are kept.
_REMARKS: Final = 20


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
        What the command reads: exited when it has ended.
    """

    kind: str
    name: str
    doing: str
    done: str
    arguments: tuple[str, ...]
    out: Path
    hidden: str
    needs: AbstractContextManager[object] = field(default_factory=nullcontext)


class Jobs:
    """One job at a time.

    Parameters
    ----------
    show
        Called with the job as the page draws it, whenever that changes, on the job's thread.
    command
        What is run, before a job's arguments.
    """

    def __init__(self, show: Callable[[dict[str, object]], None], command: Sequence[str] = _COMMAND) -> None:
        self._show = show
        self._command = command
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False

    @property
    def running(self) -> bool:
        """Whether a job is at work."""
        return self._process is not None

    def begin(self, job: Job) -> None:
        """Begin a job.

        Raises
        ------
        ServiceError
            When another is at work, or what it makes is there already.
        """
        with ExitStack() as needs:
            needs.enter_context(job.needs)
            if self.running:
                raise ServiceError("something else is being made; wait, or cancel that first")
            if job.out.exists():
                raise ServiceError(f"there is a {job.kind} {job.name} already; choose another name")
            job.out.parent.mkdir(exist_ok=True)
            self._cancelled = False
            self._process = process = subprocess.Popen(  # noqa: S603 - our own command; the paths are of listed files
                [*self._command, *job.arguments, "--out", str(job.out)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
            following = threading.Thread(
                target=self._follow, args=(job, process, needs.pop_all()), name="job", daemon=True
            )
            following.start()

    def cancel(self) -> None:
        """End the job that is at work, without what it makes."""
        process = self._process
        if process is not None:
            self._cancelled = True
            process.terminate()

    def _follow(self, job: Job, process: subprocess.Popen[str], needs: ExitStack) -> None:
        assert process.stdout is not None  # noqa: S101 - they are pipes
        assert process.stderr is not None  # noqa: S101
        said: list[str] = []
        listener = threading.Thread(target=lambda: said.extend(map(str.strip, process.stderr or ())), daemon=True)
        listener.start()
        shown = {"kind": job.kind, "name": job.name, "doing": job.doing, "done": job.done}
        self._show({**shown, "stage": "", "share": None})
        for line in process.stdout:
            try:
                told = json.loads(line)
                self._show({**shown, "stage": told["stage"], "share": told["done"] / max(told["total"], 1)})
            except (ValueError, TypeError, KeyError):
                continue  # the summary, for people at a terminal
        status = process.wait()
        listener.join()
        needs.close()
        lines = [
            printable(line.removeprefix("smal: ").replace(job.hidden, "")) for line in said if line.startswith("smal: ")
        ]
        outcome, why = "done", ""
        if self._cancelled:
            outcome = "cancelled"
        elif status != 0:
            outcome, why = "failed", (lines or [*map(printable, said)] or [f"it ended with status {status}"])[-1]
        self._process = None
        self._show({**shown, "outcome": outcome, "why": why, "remarks": lines[-_REMARKS:]})
