"""Where everything that arrives waits for the one thread that handles it."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple


class Item(NamedTuple):
    """What was taken from an inbox."""

    name: str
    """Its queue."""
    content: object
    waited_s: float
    """How long it waited, seconds."""


class Inbox:
    """Bounded queues, one a name; filled by any thread, emptied in order of arrival by one.

    A full queue gives up its oldest item, and counts it.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ready = threading.Condition()
        self._queues: dict[str, deque[tuple[int, float, object]]] = {}
        self._arrivals = 0
        self._woken = False
        self.dropped: Counter[str] = Counter()

    def open(self, name: str, depth: int) -> None:
        """Add a queue that keeps at most ``depth`` items."""
        with self._ready:
            self._queues[name] = deque(maxlen=depth)

    def put(self, name: str, item: object) -> None:
        """Add an item; never blocks."""
        now_s = self._clock()
        with self._ready:
            queue = self._queues[name]
            if len(queue) == queue.maxlen:
                self.dropped[name] += 1
            queue.append((self._arrivals, now_s, item))
            self._arrivals += 1
            self._ready.notify()

    def wake(self) -> None:
        """Make the ``take`` that waits, or else the next one, return at once."""
        with self._ready:
            # Kept: a wake between the loop's look at the stop event and its wait would otherwise be lost.
            self._woken = True
            self._ready.notify_all()

    def take(self, timeout_s: float | None) -> Item | None:
        """Return the oldest item, or None after ``timeout_s`` or a ``wake``."""
        with self._ready:
            if not any(self._queues.values()) and not self._woken:
                self._ready.wait(timeout_s)
            self._woken = False
            waiting = [(queue[0][0], name) for name, queue in self._queues.items() if queue]
            if not waiting:
                return None
            name = min(waiting)[1]
            _, arrived_s, content = self._queues[name].popleft()
        return Item(name, content, self._clock() - arrived_s)

    def waiting(self) -> dict[str, int]:
        """Return how many items wait in each queue."""
        with self._ready:
            return {name: len(queue) for name, queue in self._queues.items()}

    def oldest_s(self) -> float:
        """Return how long the oldest item has waited, 0 where none waits."""
        with self._ready:
            arrivals_s = [queue[0][1] for queue in self._queues.values() if queue]
        return max(0.0, self._clock() - min(arrivals_s)) if arrivals_s else 0.0
