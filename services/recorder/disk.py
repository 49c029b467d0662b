"""How long there is room for what is recorded: told in time, and a recording is sealed before there is none."""

import errno
import math
import shutil
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

LOOK_S: Final = 1.0  # How often the disk is looked at.
_RATE_S: Final = (
    10.0  # Over how long the rate is measured, and from how much of that on it is known.
)
_KNOWN_S: Final = 3.0
#: Who drives is told when there is room for less than that: time to come to an end, or to make room.
WARN_S: Final = 600.0
#: Recording ends while there is room for so much more of it: other programs write to the disk as well.
_CLOSE_S: Final = 10.0
LEAST_BYTES: Final = (
    64 * 2**20
)  # And for that: the largest image has 16 MB, and the index of a day 28 MB.


class Disk:
    """Watches the room on a disk; ``free`` returns how many bytes the disk of a folder still takes."""

    def __init__(
        self,
        clock: Callable[[], float],
        free: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        self._clock = clock
        self._free = free
        self._written: deque[tuple[float, int]] = deque()  # When how many bytes had been written.
        #: What whoever drives has to know, in one line; None while there is room enough.
        self.warning: str | None = None

    def check_room(self, folder: Path) -> None:
        """Begin to watch the disk of a folder; raises OSError when there is no room to record, or no such folder."""
        self._written.clear()
        if not self._told(self._free(folder), 0.0):
            raise OSError(errno.ENOSPC, self.warning)

    def look(self, folder: Path, written: int) -> bool:
        """Return whether there is room to go on after so many recorded bytes; OSError when the folder is gone."""
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
            self.warning = f"the disk is full ({free / 1e6:.0f} MB are free): no more is recorded"
            return False
        if left_s < WARN_S:
            left = (
                f"{left_s // 60:.0f} minutes"
                if left_s >= 120.0
                else f"{10 * (left_s // 10):.0f} seconds"
            )
            self.warning = f"the disk has room for {left} more"
        return True
