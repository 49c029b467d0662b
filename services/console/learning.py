"""Learning as a job: ``smal learn`` in a process of its own, so that driving goes on meanwhile."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from schemas.codec import printable
from services.kit.node import ServiceError

#: How much it gives way to the services of the stack; see nice(1).
_NICENESS: Final = 10
_COMMAND: Final = ("-c", "from services.cli.main import main; main()", "learn")
#: Lines of remarks that are kept.
_REMARKS: Final = 20


class Learning:
    """One job of learning at a time.

    Parameters
    ----------
    show
        Called with the job as the page draws it, whenever that changes, on the job's thread.
    command
        What is run, before the arguments of ``smal learn``.
    """

    def __init__(
        self, show: Callable[[dict[str, object]], None], command: Sequence[str] = (sys.executable, *_COMMAND)
    ) -> None:
        self._show = show
        self._command = command
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False

    @property
    def running(self) -> bool:
        """Whether a job is at work."""
        return self._process is not None

    def begin(self, name: str, out: Path, recordings: Sequence[Path], *, include_runs: bool) -> None:
        """Begin to learn.

        Raises
        ------
        ServiceError
            When a job is at work, or the model is there already.
        """
        if self.running:
            raise ServiceError("another model is being learned; cancel that first")
        if out.exists():
            raise ServiceError(f"there is a model {name} already; choose another name")
        out.parent.mkdir(exist_ok=True)
        flags = ["--out", str(out), "--progress", *(["--include-runs"] if include_runs else [])]
        self._cancelled = False
        self._process = process = subprocess.Popen(  # noqa: S603 - our own command; the paths are of listed files
            [*self._command, *map(str, recordings), *flags],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        threading.Thread(target=self._follow, args=(name, process), name="learning", daemon=True).start()

    def cancel(self) -> None:
        """Learn no further."""
        process = self._process
        if process is not None:
            self._cancelled = True
            process.terminate()

    def _follow(self, name: str, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None  # noqa: S101 - they are pipes
        assert process.stderr is not None  # noqa: S101
        said: list[str] = []
        listener = threading.Thread(target=lambda: said.extend(map(str.strip, process.stderr or ())), daemon=True)
        listener.start()
        self._show({"name": name, "stage": "starting", "share": 0})
        for line in process.stdout:
            try:
                told = json.loads(line)
                self._show({"name": name, "stage": told["stage"], "share": told["done"] / max(told["total"], 1)})
            except (ValueError, TypeError, KeyError):
                continue  # the summary, for people at a terminal
        status = process.wait()
        listener.join()
        lines = [printable(line.removeprefix("smal: ")) for line in said if line.startswith("smal: ")]
        outcome, why = "done", ""
        if self._cancelled:
            outcome = "cancelled"
        elif status != 0:
            outcome, why = "failed", (lines or [*map(printable, said)] or [f"it ended with status {status}"])[-1]
        self._process = None
        self._show({"name": name, "outcome": outcome, "why": why, "remarks": lines[-_REMARKS:]})
