"""When a service that has ended may be started again."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

#: Least time between two starts of a service, doubled with every death up to the longest, seconds.
FIRST_S: Final = 1.0
LONGEST_S: Final = 30.0
#: A service that has lived this long is taken for healthy again.
STEADY_S: Final = 60.0


class Backoff:
    """Spaces the starts of one service: one that worked comes back at once, one that keeps dying ever less often."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._spacing_s = FIRST_S
        self.begin()

    def begin(self) -> None:
        """Note that the service was started."""
        self._began_s = self._clock()
        self._due_s: float | None = None

    def mourn(self) -> bool:
        """Note that the service is dead; return whether that is new."""
        if self._due_s is not None:
            return False
        if self._clock() - self._began_s >= STEADY_S:
            self._spacing_s = FIRST_S
        self._due_s = self._began_s + self._spacing_s
        self._spacing_s = min(2 * self._spacing_s, LONGEST_S)
        return True

    def wait_s(self) -> float:
        """Return how long a service that is mourned still has to wait, seconds."""
        return 0.0 if self._due_s is None else max(0.0, self._due_s - self._clock())
