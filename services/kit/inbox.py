"""Queues between the receiving threads and the handling thread."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

#: Maximum bytes that wait in one inbox. After an outage a recorder, in a container of 1 GiB,
#: receives the replay at once: 30 s of half-megabyte JPEG frames are 150 MB, and the other topics
#: are a few.
MOST_BYTES: Final = 256 << 20


class Item(NamedTuple):
    """Item taken from an inbox."""

    name: str
    content: object
    waited_s: float  # Its time in the queue, seconds.


class _Waiting(NamedTuple):
    number: int
    arrived_s: float
    content: object
    size: int


@dataclass
class _Queue:
    depth: int
    items: deque[_Waiting] = field(default_factory=deque)
    size: int = 0


class Inbox:
    """Bounded queues by name, filled by any thread and emptied in order of arrival by one thread.

    A full queue drops its oldest item, and counts it. When all queues together exceed the byte
    limit, the largest queue drops items: a sender that sends too much loses only its own messages.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, most_bytes: int = MOST_BYTES
    ) -> None:
        self._clock = clock
        self._most_bytes = most_bytes
        self._ready = threading.Condition()
        self._queues: dict[str, _Queue] = {}
        self._size = 0
        self._arrivals = 0
        self._woken = False
        self.dropped: Counter[str] = Counter()

    def open(self, name: str, depth: int) -> None:
        """Add a queue with at most ``depth`` items."""
        with self._ready:
            self._queues[name] = _Queue(depth)

    def put(self, name: str, item: object, size: int) -> None:
        """Add an item of ``size`` bytes; never blocks."""
        now_s = self._clock()
        with self._ready:
            queue = self._queues[name]
            if len(queue.items) == queue.depth:
                self._drop_oldest(name)
            queue.items.append(_Waiting(self._arrivals, now_s, item, size))
            queue.size += size
            self._size += size
            self._arrivals += 1
            while self._size > self._most_bytes:
                self._drop_oldest(max(self._queues, key=lambda name: self._queues[name].size))
            self._ready.notify()

    def put_once(self, name: str) -> None:
        """Add an item without content, unless an item waits already."""
        with self._ready:
            if not self._queues[name].items:
                self.put(name, None, 0)

    def _drop_oldest(self, name: str) -> None:
        self._pop(name)
        self.dropped[name] += 1

    def _pop(self, name: str) -> _Waiting:
        queue = self._queues[name]
        oldest = queue.items.popleft()
        queue.size -= oldest.size
        self._size -= oldest.size
        return oldest

    def wake(self) -> None:
        """Make the waiting ``take``, or else the next one, return at once."""
        with self._ready:
            # Stored, so that a wake just before the wait is not lost.
            self._woken = True
            self._ready.notify_all()

    def take(self, timeout_s: float | None) -> Item | None:
        """Return the oldest item, or None after ``timeout_s`` or a ``wake``."""
        with self._ready:
            if not any(queue.items for queue in self._queues.values()) and not self._woken:
                self._ready.wait(timeout_s)
            self._woken = False
            waiting = [
                (queue.items[0].number, name) for name, queue in self._queues.items() if queue.items
            ]
            if not waiting:
                return None
            name = min(waiting)[1]
            oldest = self._pop(name)
        return Item(name, oldest.content, self._clock() - oldest.arrived_s)

    def waiting(self) -> dict[str, int]:
        """Return the number of waiting items by queue."""
        with self._ready:
            return {name: len(queue.items) for name, queue in self._queues.items()}

    def oldest_s(self) -> float:
        """Return the age of the oldest item, 0 if the inbox is empty."""
        with self._ready:
            arrivals_s = [
                queue.items[0].arrived_s for queue in self._queues.values() if queue.items
            ]
        return max(0.0, self._clock() - min(arrivals_s)) if arrivals_s else 0.0
