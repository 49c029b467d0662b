"""How busy processes are."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from schemas.rpc import Nothing, Status
from services.kit.bus import Bus


class Load:
    """Processor time that processes take while they are watched.

    Parameters
    ----------
    processes
        Names and process ids.
    """

    def __init__(self, processes: dict[str, int]) -> None:
        self._processes = processes
        self._worked_s: Counter[str] = Counter()
        self._passed_s = 0.0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Count the time of this context."""
        began_s, before_s = time.monotonic(), self._times_s()
        yield
        self._passed_s += time.monotonic() - began_s
        self._worked_s.update(self._times_s())
        self._worked_s.subtract(before_s)

    def cores(self) -> dict[str, float | None]:
        """Return the mean number of cores that each was using; None where the system does not tell."""
        return {
            name: self._worked_s[name] / self._passed_s if name in self._worked_s else None for name in self._processes
        }

    def _times_s(self) -> dict[str, float]:
        """Read user and system time off the system."""
        times: dict[str, float] = {}
        for name, pid in self._processes.items():
            try:
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            times[name] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return times


def processes_of(bus: Bus, services: Iterable[str]) -> dict[str, int]:
    """Ask services for their process ids; this process is among them as ``bench``."""
    pids = {name: bus.call(name, "status", Nothing(), Status).pid for name in services}
    return {"bench": os.getpid()} | pids
