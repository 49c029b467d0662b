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
    """Spaces the starts of one service.

    A service that worked for a while comes back at once; one that dies at every start does not take the machine
    from the others, nor fill the log.

    Parameters
    ----------
    clock
        Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._spacing_s = FIRST_S
        self.begin()

    def begin(self) -> None:
        """Note that the service was started."""
        self._began_s = self._clock()
        self._due_s: float | None = None

    @property
    def mourned(self) -> bool:
        """Whether the death of the service is known."""
        return self._due_s is not None

    def wait_s(self) -> float:
        """Return how long the dead service still has to wait; the first call notes its death."""
        now_s = self._clock()
        if self._due_s is None:
            if now_s - self._began_s >= STEADY_S:
                self._spacing_s = FIRST_S
            self._due_s = self._began_s + self._spacing_s
            self._spacing_s = min(2 * self._spacing_s, LONGEST_S)
        return max(0.0, self._due_s - now_s)
