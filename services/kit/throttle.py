"""What goes wrong again and again, told once a second."""

import math
import time
from collections.abc import Callable


class Throttle:
    """Lets one line a second through: a sender that goes on and on must not fill the disk with the log."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next_s = -math.inf

    def due(self) -> bool:
        """Whether a line may be logged now."""
        now_s = self._clock()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + 1.0
        return True
