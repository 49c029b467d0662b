"""The actuator's clock, and the tick."""

from __future__ import annotations

import time
from typing import Final

#: Time from one camera frame to the next, seconds (10 Hz).
TICK_S: Final = 0.1


def now_s() -> float:
    """Return seconds that also pass while the machine is suspended, and that nobody can set.

    With a clock that stands meanwhile, a command from before would still look fresh when the machine wakes.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)
