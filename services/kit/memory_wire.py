"""The wire inside of one process, without Zenoh: for tests, and for programs that run nodes as threads.

A program says so by opening a ``MemoryRouter``, whose address then does for the buses of that process; anywhere else
such an address is an error.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from queue import Empty, SimpleQueue
from typing import Final, NamedTuple
from weakref import WeakSet

from schemas.codec import encoding_of
from schemas.topics import KEPT_S, LANES, Lane, Topic
from services.kit.wire import TIMEOUT, Answer, BusError, Refused, Serve, Take, Wire, flaw

MEMORY: Final = "memory/"
_logger = logging.getLogger("bus")


class Sample(NamedTuple):
    """What travels."""

    key: str
    payload: bytes
    encoding: str
    sent_s: float


class _Query:
    """A request; where whoever could answer it has dropped it, its caller hears that there is no answer."""

    def __init__(self) -> None:
        self.answers: SimpleQueue[Answer | None] = SimpleQueue()

    def give(self, serve: Serve, request: bytes) -> None:
        try:
            serve(request, self._reply)
        except Exception:
            # The traceback holds this query for as long as the log keeps it.
            self.drop()
            raise

    def _reply(self, answer: Answer) -> None:
        self.answers.put(answer)

    def drop(self) -> None:
        self.answers.put(None)

    __del__ = drop


class _Lane:
    """A thread that runs handlers one after the other."""

    def __init__(self, name: str) -> None:
        self._waiting: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._open = True
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.thread.start()

    def put(self, work: Callable[[], None]) -> None:
        self._waiting.put(work)

    def close(self) -> None:
        self._open = False
        self._waiting.put(lambda: None)

    def _run(self) -> None:
        while self._open:
            self._next()
        while not self._waiting.empty():
            self._waiting.get()

    def _next(self) -> None:
        # A function of its own, so that nothing holds a request that was dropped until the next one comes.
        work = self._waiting.get()
        try:
            if self._open:
                work()
        except Exception:
            _logger.exception("a handler on the bus's thread failed")


class _Subscription(NamedTuple):
    keys: tuple[str, ...]
    lane: _Lane
    take: Callable[[Sample], None]


class MemoryRouter:
    """What those buses of this process have in common that are given its address, ``memory/NAME``.

    Raises
    ------
    BusError
        When the address is another one, or in use.
    """

    def __init__(self, endpoint: str) -> None:
        if not endpoint.startswith(MEMORY) or _ROUTERS.setdefault(endpoint, self) is not self:
            raise BusError(f"cannot listen on {endpoint[:100]!r}: expected {MEMORY}NAME that is not in use")
        self.endpoint = endpoint
        # Held wherever something is sent or declared, never while a handler runs: who comes while a sample is sent
        # gets it once, as a kept one or as a new one, and all get samples in one order.
        self.lock = threading.Lock()
        self.wires: list[MemoryWire] = []

    def close(self) -> None:
        """Stop routing."""
        _ROUTERS.pop(self.endpoint, None)
        with self.lock:
            self.wires.clear()

    def send(self, sample: Sample) -> None:
        """Hand a sample to all who take it; the caller holds the lock."""
        parts = tuple(sample.key.split("/"))
        for wire in self.wires:
            for one in wire.subscriptions:
                if matches(one.keys, parts):
                    one.lane.put(partial(one.take, sample))


_ROUTERS: Final[dict[str, MemoryRouter]] = {}


class MemoryWire(Wire):
    """A robot's wire in the memory of this process.

    Raises
    ------
    BusError
        When this process has no ``MemoryRouter`` of that address.
    """

    def __init__(self, robot: str, endpoint: str) -> None:
        if endpoint not in _ROUTERS:
            raise BusError(
                f"no router at {endpoint[:100]!r}: such an address is of a router inside of one and the same process; "
                "expected tcp/<host>:<port>"
            )
        self._router = _ROUTERS[endpoint]
        self._robot = robot
        self._lanes = {lane: _Lane(f"bus of {robot}, {lane}") for lane in LANES}
        self._kept: dict[str, deque[Sample]] = {}
        self.subscriptions: list[_Subscription] = []
        self._services: dict[str, Serve] = {}
        self._asked: WeakSet[_Query] = WeakSet()
        self._closed = False
        with self._router.lock:
            self._router.wires.append(self)

    @contextmanager
    def _routing(self) -> Iterator[list[MemoryWire]]:
        """Give the wires of the router, while nobody else uses them."""
        with self._router.lock:
            if self._closed:
                raise BusError("the bus is closed")
            yield self._router.wires

    def connected(self) -> bool:
        """Whether there is a router."""
        return _ROUTERS.get(self._router.endpoint) is self._router

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send the bytes of a message."""
        key = topic.key(self._robot)
        with self._routing():
            sample = Sample(key, payload, encoding_of(topic.message), time.time())
            if topic.recorded:
                self._kept.setdefault(key, deque(maxlen=topic.kept)).append(sample)
            self._router.send(sample)

    def has_listeners(self, topic: Topic) -> bool:
        """Whether anybody takes a topic."""
        parts = tuple(topic.key(self._robot).split("/"))
        with self._routing() as wires:
            return any(matches(one.keys, parts) for wire in wires for one in wire.subscriptions)

    def subscribe(self, topic: Topic, take: Take, refused: Refused, *, replay: bool) -> None:
        """Call ``take`` for every sample of a topic."""
        key, lane = topic.key(self._robot), self._lanes[topic.lane]

        def on_sample(sample: Sample) -> None:
            if (why := flaw(key, topic.message, sample.key, len(sample.payload), sample.encoding)) is not None:
                refused(why)
            else:
                take(sample.payload, sample.encoding, time.time() - sample.sent_s)

        with self._routing() as wires:
            oldest_s = time.time() - KEPT_S
            for wire in wires if replay else ():
                for sample in wire._kept.get(key, ()):
                    if sample.sent_s >= oldest_s:
                        lane.put(partial(on_sample, sample))
            self.subscriptions.append(_Subscription(tuple(key.split("/")), lane, on_sample))

    def listen(self, keys: str, take: Callable[[str, bytes, str], None], *, lane: Lane) -> None:
        """Call ``take(key, payload, encoding)`` for every sample on matching keys."""

        def on_sample(sample: Sample) -> None:
            take(sample.key, sample.payload, sample.encoding)

        parts = key_expression(keys)
        with self._routing():
            self.subscriptions.append(_Subscription(parts, self._lanes[lane], on_sample))

    def serve(self, key: str, answer: Serve, refused: Refused) -> None:
        """Answer calls of a key."""

        def on_request(request: bytes, send: Callable[[Answer], None]) -> None:
            if (why := flaw(key, None, key, len(request))) is not None:
                refused(why)
                send(Answer.refusal(why))
            else:
                answer(request, send)

        with self._routing():
            self._services[key] = on_request

    def call(self, key: str, request: bytes, timeout_s: float) -> Answer | None:
        """Call a key and wait for the answer."""
        if threading.current_thread() is self._lanes["ordinary"].thread:
            raise BusError(f"call of {key} on the bus's own thread: it would wait for itself")
        with self._routing() as wires:
            server = next((wire for wire in wires if key in wire._services), None)
            if server is None:
                return None
            answers = server._ask(key, request)
        try:
            answer = answers.get(timeout=timeout_s)
        except Empty:
            return Answer(TIMEOUT, failed=True)
        why = None if answer is None else flaw(key, None, key, len(answer.payload))
        return answer if why is None else Answer(f"unfit reply: {why}".encode(), failed=True)

    def _ask(self, key: str, request: bytes) -> SimpleQueue[Answer | None]:
        query = _Query()
        self._asked.add(query)
        self._lanes["ordinary"].put(partial(query.give, self._services[key], request))
        return query.answers

    def close(self) -> None:
        """Take back every declaration."""
        with self._router.lock:
            self._closed = True
            if self in self._router.wires:
                self._router.wires.remove(self)
            asked = list(self._asked)
        for query in asked:
            query.drop()
        for lane in self._lanes.values():
            lane.close()


def key_expression(keys: str) -> tuple[str, ...]:
    """Return the parts of a key expression.

    Raises
    ------
    BusError
        When it is none in Zenoh's normal form, or has ``$*``, which stands for a piece of a part.
    """
    parts = tuple(keys.split("/"))
    for part, after in pairwise((*parts, "end")):
        if not part or (part not in ("*", "**") and set(part) & set("*#?$")):
            raise BusError(f"invalid key expression {keys[:100]!r}: it has the part {part[:100]!r}")
        if part == "**" and after in ("*", "**"):
            raise BusError(f"invalid key expression {keys[:100]!r}: write **/** as **, and **/* as */**")
    return parts


def matches(pattern: tuple[str, ...], key: tuple[str, ...]) -> bool:
    """Whether a key is one of those that a key expression stands for; both in parts."""
    if not pattern:
        return not key
    first, rest = pattern[0], pattern[1:]
    if first == "**":
        return any(matches(rest, key[count:]) for count in range(len(key) + 1))
    return bool(key) and first in ("*", key[0]) and matches(rest, key[1:])
