"""The actuator's clock, the tick, and the pulse."""

import time
from typing import Final

#: Time from one camera frame to the next, seconds (10 Hz).
TICK_S: Final = 0.1
#: Time from one pulse, which the robot's operator answers, to the next, seconds.
PULSE_S: Final = 0.05


def now_s() -> float:
    """Return seconds that nobody can set, and that pass in suspension too: no command looks fresh after it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
