"""Where everything that arrives waits for the one thread that handles it."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

#: Bytes that wait in one inbox. A recorder, in a container of 1 GiB, has to hold what is replayed at once after an
#: outage: 30 s of frames as JPEG of half a megabyte are 150 MB, and all else is a few.
MOST_BYTES: Final = 256 << 20


class Item(NamedTuple):
    """What was taken from an inbox."""

    name: str  # Its queue.
    content: object
    waited_s: float  # How long it waited, seconds.


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
    """Bounded queues, one a name; filled by any thread, emptied in order of arrival by one.

    A full queue gives up its oldest item, and counts it. When all together hold too many bytes, the one that holds most
    of them does: whoever sends more than is handled loses their own, and nobody else's.
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
        """Add a queue that keeps at most ``depth`` items."""
        with self._ready:
            self._queues[name] = _Queue(depth)

    def put(self, name: str, item: object, size: int) -> None:
        """Add an item of ``size`` bytes; never blocks."""
        now_s = self._clock()
        with self._ready:
            queue = self._queues[name]
            if len(queue.items) == queue.depth:
                self._give_up(name)
            queue.items.append(_Waiting(self._arrivals, now_s, item, size))
            queue.size += size
            self._size += size
            self._arrivals += 1
            while self._size > self._most_bytes:
                self._give_up(max(self._queues, key=lambda name: self._queues[name].size))
            self._ready.notify()

    def put_once(self, name: str) -> None:
        """Add an item without content, unless one waits already."""
        with self._ready:
            if not self._queues[name].items:
                self.put(name, None, 0)

    def _give_up(self, name: str) -> None:
        self._pop(name)
        self.dropped[name] += 1

    def _pop(self, name: str) -> _Waiting:
        queue = self._queues[name]
        oldest = queue.items.popleft()
        queue.size -= oldest.size
        self._size -= oldest.size
        return oldest

    def wake(self) -> None:
        """Make the ``take`` that waits, or else the next one, return at once."""
        with self._ready:
            # Kept: a wake between the loop's look at the stop event and its wait would otherwise be lost.
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
        """Return how many items wait in each queue."""
        with self._ready:
            return {name: len(queue.items) for name, queue in self._queues.items()}

    def oldest_s(self) -> float:
        """Return how long the oldest item has waited, 0 where none waits."""
        with self._ready:
            arrivals_s = [
                queue.items[0].arrived_s for queue in self._queues.values() if queue.items
            ]
        return max(0.0, self._clock() - min(arrivals_s)) if arrivals_s else 0.0
