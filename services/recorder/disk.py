"""Supervision of free disk space: warns in time, and stops while a recording can still be sealed."""

import errno
import math
import shutil
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

LOOK_S: Final = 1.0  # Period of the checks.
_RATE_S: Final = 10.0  # Window for the rate of writing.
_KNOWN_S: Final = 3.0  # Minimum of that window.
#: The driver is warned at this remaining time: enough to finish, or to make room.
WARN_S: Final = 600.0
#: Recording ends at this remaining time: other programs write to the disk as well.
_CLOSE_S: Final = 10.0
#: Free space reserved for sealing: the largest image has 16 MB, the index of a day 28 MB.
LEAST_BYTES: Final = 64 * 2**20


class Disk:
    """Watches the free space of a disk; ``free`` returns the free bytes of a folder's disk."""

    def __init__(
        self,
        clock: Callable[[], float],
        free: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        self._clock = clock
        self._free = free
        self._written: deque[tuple[float, int]] = deque()  # Pairs of time and total written bytes.
        #: Warning for the driver, in one line; None if there is enough space.
        self.warning: str | None = None

    def check_room(self, folder: Path) -> None:
        """Start to watch the disk of a folder; OSError if it is full, or the folder is not found."""
        self._written.clear()
        if not self._told(self._free(folder), 0.0):
            raise OSError(errno.ENOSPC, self.warning)

    def look(self, folder: Path, written: int) -> bool:
        """Return whether there is space after this number of written bytes."""
        now_s = self._clock()
        self._written.append((now_s, written))
        while now_s - self._written[0][0] > _RATE_S:
            self._written.popleft()
        began_s, before = self._written[0]
        rate = (written - before) / (now_s - began_s) if now_s - began_s >= _KNOWN_S else 0.0
        return self._told(self._free(folder), rate)

    def _told(self, free: int, rate: float) -> bool:
        room = free - LEAST_BYTES
        left_s = room / rate if rate > 0.0 else math.inf
        self.warning = None
        if room <= 0 or left_s <= _CLOSE_S:
            self.warning = f"disk full ({free / 1e6:.0f} MB free); recording stopped"
            return False
        if left_s < WARN_S:
            left = (
                f"{left_s // 60:.0f} minutes"
                if left_s >= 120.0
                else f"{10 * (left_s // 10):.0f} seconds"
            )
            self.warning = f"disk almost full: space for {left} of recording"
        return True
