"""The actuator's clock, the tick, and the pulse."""

import time
from typing import Final

TICK_S: Final = 0.1  # Time from one camera frame to the next, seconds (10 Hz).
PULSE_S: Final = (
    0.05  # Time from one pulse, which the robot's operator answers, to the next, seconds.
)


def now_s() -> float:
    """Return seconds that nobody can set, and that pass in suspension too: no command looks fresh after it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
