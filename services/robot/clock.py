"""The actuator's clock, the tick, and the pulse."""

import time
from typing import Final

#: Time from one camera frame to the next, seconds (10 Hz).
TICK_S: Final = 0.1
#: Time from one pulse, which the robot's operator answers, to the next, seconds.
PULSE_S: Final = 0.05


def now_s() -> float:
    """Return seconds that also pass while the machine is suspended, and that nobody can set.

    With a clock that stands meanwhile, a command from before would still look fresh when the machine wakes.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)
