"""Process of a service: signals, health, and one event loop.

The handlers of a ``Node`` run on the one thread that calls ``spin``, for messages, requests and
timers alike. A service therefore needs no locks.
"""

import logging
import os
import secrets
import signal
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Final, Literal, Self, TypeVar, cast

from pydantic import ValidationError

from schemas.base import Message, Strict
from schemas.codec import DecodeError, decode, describe
from schemas.command import Command
from schemas.rpc import Failure, Nothing, Status
from schemas.snapshot import Snapshot
from schemas.topics import Topic, key_of
from services.kit.bus import PATIENCE_S, Bus, Refused
from services.kit.ending import check_memory, ends_soon
from services.kit.errors import JobError, out_of_memory
from services.kit.health import Metrics, ailment, serve_http
from services.kit.inbox import MOST_BYTES, Inbox, Item
from services.kit.settings import FleetSettings, ServiceSettings
from services.kit.throttle import Throttle
from services.table import role_of

REQUEST_QUEUE: Final = 64
#: Time limit for threads to end when a node closes; they end with the process in any case.
_LAST_WORK_S: Final = 10.0
#: How often a waiting loop checks whether it was stopped, seconds. A signal just before a wait does
#: not end it, since Python calls the handler only after the wait.
LOOK_S: Final = 0.2
SNAPSHOT_S: Final = 1.0  # Period of the published snapshots.
# Prefix of internal queues, which are excluded from the status.
_SOON: Final = "soon/"
M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Strict)
A = TypeVar("A")
Detail = dict[str, str | int | float | bool | None]


class ServiceError(JobError):
    """Refusal of a service, whose text reaches the caller."""


@dataclass
class _Timer:
    period_s: float
    handler: Callable[[], object]
    due_s: float


def on_signals(log: logging.Logger, stop: Callable[[], None]) -> None:
    """Call ``stop`` on SIGTERM, SIGINT and, unless started with ``nohup``, SIGHUP (closed terminal).

    ``stop`` must not take a lock, which the interrupted thread can hold. Loops check its flag
    themselves.
    """

    def on_signal(number: int, _frame: FrameType | None) -> None:
        log.info("%s: stopping", signal.Signals(number).name)
        stop()

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, on_signal)


class Node:
    """Process on the bus, named after its service.

    Handlers take one message and return the messages to publish (or None). They run one at a time,
    on the thread that calls ``spin``. An exception in a handler is logged and counted; the node
    continues. Nodes of several robots in one process share its ``bus``.

    Raises
    ------
    BusError
        If no router accepts the connection within ``patience_s``.
    JobError
        If ``settings.http`` is unavailable.
    """

    def __init__(
        self,
        name: str,
        settings: ServiceSettings,
        patience_s: float = PATIENCE_S,
        *,
        bus: Bus | None = None,
        instance: str = "",
    ) -> None:
        self.name = name
        self.robot = settings.robot
        #: Random id of the process, to distinguish processes of the same name.
        self.session = secrets.token_hex(8)
        self.log = logging.getLogger(name)
        self.bus = (
            settings.open_bus(role_of(name), patience_s)
            if bus is None
            else bus.of_robot(settings.robot)
        )
        self.instance = instance  # Instance of a group that it belongs to, if any.
        # Snapshot of the instance that served the robot before.
        self.inherited: Snapshot | None = None
        self.detail: Callable[[], Detail] = dict
        robots = settings.robots if isinstance(settings, FleetSettings) else 1
        # The messages of one robot cannot displace those of another.
        self._inbox = Inbox(most_bytes=MOST_BYTES // robots)
        self._handlers: dict[str, Callable[[object], None]] = {}
        self._timers: list[_Timer] = []
        self._apart: list[threading.Thread] = []
        self._closed = threading.Event()
        self._stop = threading.Event()
        self._failure: Exception | None = None  # Error of any thread that ends the process.
        self._state: Literal["starting", "ready", "stopping"] = "starting"
        self._started_s = self._worked_s = time.monotonic()
        self._began_s: float | None = None
        self._received: Counter[str] = Counter()
        self._published: Counter[str] = Counter()
        self._bad: Counter[str] = Counter()
        self._complaints: defaultdict[tuple[str, str], Throttle] = defaultdict(Throttle)
        self._counting = threading.Lock()  # Held to count errors, which occur on several threads.
        self._failed = 0
        self.metrics = Metrics(name, settings.robot, self.status)
        self._http = None
        if settings.http is not None:
            self._http = serve_http(
                settings.http, lambda: ailment(self.status()), self.metrics.registry
            )
        self.bus.serve(
            name,
            "status",
            lambda _request, reply: reply(self.status()),
            partial(self._refuse, "rpc/status"),
        )

    # -- wiring ------------------------------------------------------------------------------------

    def subscribe(
        self,
        topic: Topic,
        handler: Callable[[M], Message | Iterable[Message] | None],
        depth: int | None = None,
        *,
        replay: bool = False,
    ) -> None:
        """Handle every message of a topic.

        Parameters
        ----------
        topic
            Topic to subscribe to.
        handler
            Called with each message; returns the messages to publish.
        depth
            Length of the queue; the topic's by default.
        replay
            See `Bus.subscribe`.
        """
        self._inbox.open(topic.name, depth or topic.queue)
        refuse = partial(self._refuse, topic.name)
        read = self._reader(topic, handler, refuse)
        self._handlers[topic.name] = lambda item: self.publish(
            read(*cast("tuple[bytes, str]", item))
        )

        def take(payload: bytes, encoding: str, transit_s: float | None) -> None:
            self._inbox.put(topic.name, (payload, encoding), len(payload))
            if transit_s is not None:
                self.metrics.took("transit", topic.name, transit_s)

        self.bus.subscribe(topic, take, refuse, replay=replay)

    def at_once(
        self,
        topic: Topic,
        handler: Callable[[M], None],
        otherwise: Callable[[], None] = lambda: None,
    ) -> None:
        """Handle a topic on the bus's thread, ahead of the queue; ``otherwise`` for bad ones."""

        def refuse(why: str) -> None:
            otherwise()
            self._refuse(topic.name, why)

        read = self._reader(topic, handler, refuse)

        def take(payload: bytes, encoding: str, _transit_s: float | None) -> None:
            with self._surviving(topic.name):
                read(payload, encoding)

        self.bus.subscribe(topic, take, refuse)

    def _reader(
        self, topic: Topic, handler: Callable[[M], A], refuse: Refused
    ) -> Callable[[bytes, str], A | None]:
        """Create a function that decodes a payload for a handler, and counts it."""

        def read(payload: bytes, encoding: str) -> A | None:
            try:
                message = decode(topic.message, payload, encoding)
                if key_of(message) != topic.key(self.robot):
                    raise DecodeError(
                        f"message of {message.robot}/{message.topic_name} on the key of {self.robot}"
                    )
            except DecodeError as error:
                refuse(str(error))
                return None
            self._received[topic.name] += 1
            return handler(cast("M", message))

        return read

    def serve(
        self,
        verb: str,
        request_type: type[R],
        handler: Callable[[R], Strict | None],
        *,
        at_once: bool = False,
    ) -> None:
        """Answer calls of ``rpc/<name>/<verb>``; the text of a ``ServiceError`` reaches the caller.

        With ``at_once`` the handler runs on the bus's thread, ahead of the queue, and must return
        at once.
        """
        name = f"rpc/{verb}"
        self._inbox.open(name, REQUEST_QUEUE)

        def work(item: object) -> None:
            payload, reply = cast("tuple[bytes, Callable[[Strict], None]]", item)
            try:
                reply(handler(request_type.model_validate_json(payload)) or Nothing())
            except ValidationError as error:
                self._refuse(name, describe(error))
                reply(Failure(error=describe(error)))
            except ServiceError as error:
                if self._complaints["refused", name].due():
                    self.log.warning("%s refused: %s", verb, error)
                reply(Failure(error=str(error)))
            except Exception:
                reply(Failure(error=self.own_fault))
                raise

        def take(payload: bytes, reply: Callable[[Strict], None]) -> None:
            if not at_once:
                self._inbox.put(name, (payload, reply), len(payload))
                return
            with self._surviving(name):
                work((payload, reply))

        self._handlers[name] = work
        self.bus.serve(self.name, verb, take, partial(self._refuse, name))

    def soon(self, handler: Callable[[], object]) -> Callable[[], None]:
        """Return a thread-safe trigger of ``handler`` on the node's thread; pending triggers merge."""
        name = f"{_SOON}{len(self._handlers)}"
        self._inbox.open(name, 1)

        def work(_: object) -> None:
            handler()

        self._handlers[name] = work
        return lambda: self._inbox.put_once(name)

    def waits(self, topic: Topic) -> bool:
        """Return whether a message of a topic waits to be handled."""
        return self._inbox.waiting().get(topic.name, 0) > 0

    def idle(self) -> bool:
        """Return whether all received messages are handled."""
        return not any(self._inbox.waiting().values())

    def every(self, period_s: float, handler: Callable[[], object]) -> None:
        """Call ``handler`` every ``period_s`` seconds; periods missed while busy are skipped."""
        self._timers.append(_Timer(period_s, handler, time.monotonic() + period_s))

    @property
    def own_fault(self) -> str:
        """Answer to a caller after a bug in this service; the log has the details."""
        return f"internal error; see the log of {self.name}"

    def apart(self, period_s: float, handler: Callable[[], Message | None]) -> None:
        """Publish the results of ``handler`` every ``period_s`` on a separate thread, until closed."""

        def repeat() -> None:
            while not self._closed.wait(period_s):
                with self._surviving(handler.__name__):
                    self.publish(handler())

        thread = threading.Thread(
            target=repeat, name=f"{self.name}, {handler.__name__}", daemon=True
        )
        self._apart.append(thread)
        thread.start()

    # -- work --------------------------------------------------------------------------------------

    def publish(self, messages: Message | Iterable[Message] | None) -> None:
        """Publish the messages."""
        for message in [messages] if isinstance(messages, Message) else messages or ():
            # Signed centrally, so that the robot can always distinguish two senders of one kind.
            signed = (
                message.model_copy(update={"session": self.session})
                if isinstance(message, Command)
                else message
            )
            self.bus.publish(signed)
            self._published[message.topic_name] += 1

    def spin(
        self, until: Callable[[], bool] = lambda: False, timeout_s: float | None = None
    ) -> bool:
        """Handle what arrives until ``until()`` holds (True), or until a timeout or stop (False).

        Raises
        ------
        BusError
            If a lane of the bus stays deaf.
        MemoryError, OSError
            If memory is exhausted.
        """
        with ends_soon():
            return self._spin(until, timeout_s)

    def _spin(self, until: Callable[[], bool], timeout_s: float | None) -> bool:
        self._state = "ready"
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._stop.is_set():
            self.bus.check()
            check_memory()
            if until():
                return True
            now = time.monotonic()
            if deadline is not None and now >= deadline:
                return False
            dues = [timer.due_s for timer in self._timers] + (
                [deadline] if deadline is not None else []
            )
            self._handle(self._inbox.take(max(0.0, min([*dues, now + LOOK_S]) - now)))
        self._state = "stopping"
        if self._failure is not None:
            raise self._failure
        return False

    def drain(self) -> None:
        """Handle the items that arrived before the node was stopped."""
        while (item := self._inbox.take(0.0)) is not None:
            self._handle(item)

    def stop(self) -> None:
        """Make ``spin`` return."""
        self._stop.set()
        self._inbox.wake()

    def stop_on_signals(self) -> None:
        """Stop on the signals of `on_signals`."""
        on_signals(self.log, self._stop.set)

    def _handle(self, item: Item | None) -> None:
        with self._surviving(item.name if item is not None else "a timer"):
            if item is not None:
                self._work(item)
            for timer in self._timers:
                if time.monotonic() >= timer.due_s:
                    timer.due_s = max(timer.due_s + timer.period_s, time.monotonic())
                    self._began_s = time.monotonic()
                    timer.handler()
                    self._worked_s = time.monotonic()
        self._began_s = None

    def _work(self, item: Item) -> None:
        began_s = self._began_s = time.monotonic()
        self._handlers[item.name](item.content)
        self._worked_s = time.monotonic()
        self.metrics.took("wait", item.name, item.waited_s)
        self.metrics.took("work", item.name, self._worked_s - began_s)

    @contextmanager
    def _surviving(self, name: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if out_of_memory(error):
                self._failure = error
                self.stop()
                return
            with self._counting:
                self._failed += 1
                due = self._complaints["failed", name].due()
            if due:
                # Bugs are logged with their traceback, refusals of a service with their text only.
                bug = None if isinstance(error, ServiceError) else error
                level = logging.WARNING if bug is None else logging.ERROR
                self.log.log(
                    level,
                    "handling %s failed (%d failures in total): %s",
                    name,
                    self._failed,
                    error,
                    exc_info=bug,
                )

    def _refuse(self, name: str, why: str) -> None:
        """Count and log an invalid message or request; thread-safe."""
        with self._counting:
            self._bad[name] += 1
            count = self._bad[name]
            due = self._complaints["bad", name].due()
        if due:
            self.log.warning("dropped an invalid message on %s (%d in total): %s", name, count, why)

    # -- health ------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Return the state of this node; thread-safe."""
        now = time.monotonic()
        silent = self.bus.silent()
        return Status(
            service=self.name,
            state=self._state,
            pid=os.getpid(),
            connected=not silent,
            silent=silent,
            uptime_s=round(now - self._started_s, 3),
            idle_s=round(now - self._worked_s, 3),
            busy_s=round(now - began_s, 3) if (began_s := self._began_s) is not None else 0.0,
            oldest_s=round(self._inbox.oldest_s(), 3),
            waiting={
                name: many
                for name, many in self._inbox.waiting().items()
                if not name.startswith(_SOON)
            },
            received=dict(self._received),
            published=dict(self._published),
            dropped=dict(self._inbox.dropped),
            bad=dict(self._bad),
            failed=self._failed,
            detail=self.detail() | ({"instance": self.instance} if self.instance else {}),
        )

    def close(self) -> None:
        """Leave the bus, once; separate threads have `_LAST_WORK_S` to end."""
        if self._closed.is_set():
            return
        self._closed.set()
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
        until_s = time.monotonic() + _LAST_WORK_S
        for thread in self._apart:
            thread.join(max(0.0, until_s - time.monotonic()))
            if thread.is_alive():
                self.log.warning("the thread %r did not end within %g s", thread.name, _LAST_WORK_S)
        self.bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()
