"""How long to wait for processes that are not ready yet: for as long as they work, however slow the machine is."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from services.kit.errors import JobError

#: Who has hardly used the processor for so long hangs; a service that waits for another one gives up long before.
HANGS_S: Final = 60.0
#: Share of a processor: whoever is connected and waits uses a tenth of it, who works beside a hundred others more.
LEAST_SHARE: Final = 0.01
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


class Patience:
    """Waits for services, tells whom it waits for and how long already, and gives up on one that hangs.

    `last_line` gives what a service said last of what it is doing, if that is known, and `used_s` the processor time of
    a process, seconds.
    """

    def __init__(
        self,
        last_line: Callable[[str], str],
        used_s: Callable[[int], float] = processor_s,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._last_line, self._used_s, self._clock = last_line, used_s, clock
        self._began_s = clock()
        self._told_s = 0.0
        #: When each service was last known to work, and how much processor time it had used by then.
        self._worked: dict[str, tuple[float, float]] = {}

    def check(self, pids: Mapping[str, int]) -> float:
        """Look at services that are not ready, given with their process ids; return how long they are waited for.

        Raises JobError when one of them has hardly done anything for `HANGS_S`.
        """
        now_s = self._clock()
        waited_s = now_s - self._began_s
        for service, pid in pids.items():
            used_s = self._used_s(pid)
            since_s, before_s = self._worked.setdefault(service, (now_s, used_s))
            if used_s - before_s > LEAST_SHARE * HANGS_S:
                self._worked[service] = now_s, used_s
            elif now_s - since_s > HANGS_S:
                raise JobError(f"{service} hangs: not ready after {waited_s:.0f} s{self._doing(service)}")
        return waited_s

    def wait(self, pids: Mapping[str, int]) -> None:
        """Wait a little for services; see `check`."""
        waited_s = self.check(pids)
        if waited_s - self._told_s >= _TELL_S:
            self._told_s = waited_s
            for service in pids:
                _log.warning("waiting for %s, %.0f s so far%s", service, waited_s, self._doing(service))
        # Less often the longer it takes: to answer is work as well.
        time.sleep(max(0.05, waited_s / 50.0))

    def _doing(self, service: str) -> str:
        line = self._last_line(service)
        return f" ({line})" if line else ""
