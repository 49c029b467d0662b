"""The actuator's clock, the tick, and the pulse."""

import time
from collections.abc import Callable
from typing import Final, NamedTuple

# Time between two camera frames, seconds (10 Hz).
TICK_S: Final = 0.1
# Time between two pulses, which the robot's operator answers, seconds.
PULSE_S: Final = 0.05


class Clocks(NamedTuple):
    """Clocks of a robot."""

    monotonic_s: Callable[[], float]
    wall_ns: Callable[[], int]  # Nanoseconds since 1970.


def now_s() -> float:
    """Return seconds of a clock that cannot be set and that continues during suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


CLOCKS: Final = Clocks(now_s, time.time_ns)
