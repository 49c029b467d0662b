"""The actuator's clock, the tick, and the pulse."""

import time
from collections.abc import Callable
from typing import Final, NamedTuple

TICK_S: Final = 0.1  # Time from one camera frame to the next, seconds (10 Hz).
PULSE_S: Final = (
    0.05  # Time from one pulse, which the robot's operator answers, to the next, seconds.
)


class Clocks(NamedTuple):
    """Clocks of a robot."""

    monotonic_s: Callable[[], float]
    wall_ns: Callable[[], int]  # Nanoseconds since 1970.


def now_s() -> float:
    """Return seconds that nobody can set, and that pass in suspension too: no command looks fresh after it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


CLOCKS: Final = Clocks(now_s, time.time_ns)
