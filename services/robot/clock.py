"""The actuator's clock, the pulse, and the timeouts of silent senders."""

import math
import time
from collections.abc import Callable
from threading import Lock
from typing import Final, NamedTuple

# Time between two pulses, which the robot's operator answers, seconds.
PULSE_S: Final = 0.05
#: Time since its arrival at which a command expires, seconds. The robot must stand 0.5 s after the
#: last command; the rest is for braking, see `services.robot.loop`.
SILENCE_S: Final = 0.25
#: Age of the last answered pulse or echo at which its sender counts as absent, seconds. The
#: round trip of an answer can take all of it but one pulse, 0.2 s.
ABSENT_S: Final = 5 * PULSE_S
#: Real time that simulated time waits for a frame or an answer, seconds: an answer is sent again
#: after as long in lockstep (`services.robot.lockstep.RESEND_S`). A dead driver then falls silent.
PATIENCE_S: Final = 2.0


class Clocks(NamedTuple):
    """Clocks of a robot."""

    monotonic_s: Callable[[], float]
    wall_ns: Callable[[], int]  # Nanoseconds since 1970.
    #: Sets the time at which a simulated robot's clock waits; a real robot's clock never waits.
    hold: Callable[[float], None] = lambda _until_s: None


def now_s() -> float:
    """Return seconds of a clock that cannot be set and that continues during suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class SimulatedClock:
    """Clock of a simulated robot: real time, except that it can wait.

    A computer that is too slow for real time thus slows the world instead of making commands stale.
    All limits of the robot hold on this clock, such as the time after which silence stops it. It
    waits for at most `PATIENCE_S`, and then passes until the next ``hold`` with another time.
    Thread-safe.

    Parameters
    ----------
    real_s : callable
        Monotonic time in seconds.
    """

    def __init__(self, real_s: Callable[[], float] = now_s) -> None:
        self._real_s = real_s
        self._read_s = self._now_s = real_s()
        self._until_s = math.inf
        self._waited_s = 0.0
        self._lock = Lock()

    @property
    def clocks(self) -> Clocks:
        """The clocks of a robot: this one, and the time of day, which does not wait."""
        return Clocks(self, time.time_ns, self.hold)

    def __call__(self) -> float:
        """Return the simulated time, seconds."""
        with self._lock:
            return self._pass()

    def hold(self, until_s: float) -> None:
        """Wait at a time, until another call with a later one."""
        with self._lock:
            self._pass()
            if until_s != self._until_s:
                self._until_s = until_s
                self._waited_s = 0.0

    def _pass(self) -> float:
        real_s = self._real_s()
        passed_s = real_s - self._read_s
        self._read_s = real_s
        waits_s = passed_s - max(self._until_s - self._now_s, 0.0)
        if waits_s > 0.0 and self._waited_s < PATIENCE_S:
            self._waited_s += waits_s
            passed_s -= waits_s
        self._now_s += passed_s
        return self._now_s


CLOCKS: Final = Clocks(now_s, time.time_ns)
