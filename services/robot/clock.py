"""The actuator's clock, the pulse, and the timeouts of silent senders."""

import time
from collections.abc import Callable
from typing import Final, NamedTuple

# Time between two pulses, which the robot's operator answers, seconds.
PULSE_S: Final = 0.05
#: Time since its arrival at which a command expires, seconds. The robot must stand 0.5 s after the
#: last command; the rest is for braking, see `services.robot.loop`.
SILENCE_S: Final = 0.25
#: Age of the last answered pulse or echo at which its sender counts as absent, seconds. The
#: round trip of an answer can take all of it but one pulse, 0.2 s.
ABSENT_S: Final = 5 * PULSE_S


class Clocks(NamedTuple):
    """Clocks of a robot."""

    monotonic_s: Callable[[], float]
    wall_ns: Callable[[], int]  # Nanoseconds since 1970.


def now_s() -> float:
    """Return seconds of a clock that cannot be set and that continues during suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


CLOCKS: Final = Clocks(now_s, time.time_ns)
