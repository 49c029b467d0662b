"""How long to wait for processes that are not ready yet: for as long as they work, however slow the machine is."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from services.kit.errors import JobError

#: Who has hardly used the processor for so long hangs; a service that waits for another one gives up long before.
HANGS_S: Final = 60.0
#: Share of a processor: whoever is connected and waits uses a tenth of it, who works beside a hundred others more.
_LEAST_SHARE: Final = 0.01
#: How often whoever waits is told.
_TELL_S: Final = 10.0
_log = logging.getLogger("stack")


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used, seconds; 0 where no such process, or no /proc, tells it."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Worker:
    """Tells whether a process works or hangs, by the processor time that it uses.

    Parameters
    ----------
    used_s
        Processor time so far.
    clock
        Monotonic seconds.
    """

    def __init__(self, used_s: Callable[[], float], clock: Callable[[], float] = time.monotonic) -> None:
        self._used_s, self._clock = used_s, clock
        self._before, self._since_s = used_s(), clock()

    def hangs(self) -> bool:
        """Whether it has hardly done anything for `HANGS_S`; to be asked now and then."""
        used_s, now_s = self._used_s(), self._clock()
        if used_s - self._before > _LEAST_SHARE * HANGS_S:
            self._before, self._since_s = used_s, now_s
        return now_s - self._since_s > HANGS_S


class Patience:
    """Waits for services, tells whom it waits for and how long already, and gives up on one that hangs.

    Parameters
    ----------
    last_line
        What a service said last of what it is doing; empty where that is not known.
    """

    def __init__(self, last_line: Callable[[str], str]) -> None:
        self._last_line = last_line
        self._began_s = time.monotonic()
        self._told_s = 0.0
        self._workers: dict[str, Worker] = {}

    def wait(self, pids: Mapping[str, int]) -> None:
        """Wait a little for services that are not ready, given with their process ids.

        Raises
        ------
        JobError
            When one of them hangs.
        """
        waited_s = time.monotonic() - self._began_s
        for service, pid in pids.items():
            worker = self._workers.setdefault(service, Worker(partial(processor_s, pid)))
            if worker.hangs():
                raise JobError(f"{service} hangs: not ready after {waited_s:.0f} s{self._doing(service)}")
        if waited_s - self._told_s >= _TELL_S:
            self._told_s = waited_s
            for service in pids:
                _log.warning("waiting for %s, %.0f s so far%s", service, waited_s, self._doing(service))
        # Less often the longer it takes: to answer is work as well.
        time.sleep(max(0.05, waited_s / 50.0))

    def _doing(self, service: str) -> str:
        line = self._last_line(service)
        return f" ({line})" if line else ""
