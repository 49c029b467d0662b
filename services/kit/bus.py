"""The bus: messages and calls over Zenoh through one or several routers.

See `services.kit.wire` for its guarantees.
"""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeVar, cast

import zenoh
import zenoh.ext
from pydantic import ValidationError

from schemas.base import Message, Strict
from schemas.codec import describe, encode, encoding_of
from schemas.rpc import Failure
from schemas.topics import KEPT_S, LANES, TOPICS, Lane, Topic, rpc_key
from services.kit.connection import Connection, Declared, Entity
from services.kit.credentials import Credentials
from services.kit.echo import DEAF_S, SILENT_S, LaneEcho
from services.kit.errors import JobError
from services.kit.history import in_order, subscribe_whole
from services.kit.replay import Budget
from services.kit.wire import MAX_RPC_BYTES, BusError, Refused, Take, checksum, damage, flaw, reason
from services.kit.zenoh_session import (
    DEFAULT_ROUTER,
    Router,
    addresses,
    check_credentials,
    host_and_port,
    open_client,
    quality,
    zenoh_quality,
    zenohd_configuration,
)
from services.table import SERVICES

__all__ = [
    "DEFAULT_ROUTER",
    "PATIENCE_S",
    "Bus",
    "BusError",
    "Refused",
    "Router",
    "RpcError",
    "Take",
    "addresses",
    "check_credentials",
    "host_and_port",
    "zenohd_configuration",
]

# How long a process waits for a router, or a service, that is perhaps just starting.
PATIENCE_S: Final = 10.0
#: How often a publisher sends its sample count, so that subscribers notice missing samples; also
#: after long silence, since the router can have been away.
HEARTBEAT_S: Final = 0.25
#: Priority of replayed samples. It equals the priority of the message that ends Zenoh's reply; at a
#: lower priority that message overtakes samples on a busy machine, and they are lost.
REPLAY_PRIORITY: Final = zenoh.Priority.DATA
#: Maximum bytes of samples that wait for replayed samples, over all topics: six megabytes a second
#: for ten seconds, which covers JPEG frames at 10 Hz and the other topics.
HELD_BYTES: Final = 64 << 20
# Length of the queue of one key's calls; the oldest calls beyond it are dropped.
WAITING_CALLS: Final = 32
CALLS_SHARE: Final = 0.1  # Maximum share of a processor for answering the calls of one key.
MOVE_S: Final = 2.0  # Maximum time without an instance when one of several leaves.
_AGAIN_S: Final = 0.05  # Pause between two attempts of an unanswered call.
# Calls go ahead of images and replayed samples.
_CALL_PRIORITY: Final = zenoh.Priority.INTERACTIVE_LOW
_LAST_ANSWER_S: Final = 1.0  # How long closing waits for a call that is being answered.
_PUT: Final = zenoh.SampleKind.PUT
_MOST_TOKENS: Final = 1 << 16  # More than all sessions may declare at a router.
JSON_ENCODING: Final = zenoh.Encoding("application/json")
_logger = logging.getLogger("bus")
R = TypeVar("R", bound=Strict)
E = TypeVar("E", bound=Entity)


class RpcError(JobError):
    """A call that the service refused or did not answer."""


class Bus:
    """Connection of one process to the routers, for one robot.

    Each lane is a session of its own, so that an image cannot delay a command, and nothing delays a
    stop. After an outage the connection is restored in the background (`connection`), by the next
    of several routers. Echoes prove that every lane carries both ways (`echo`).

    Parameters
    ----------
    robot
        Id of the robot, part of every key.
    endpoint
        Address of the router, or addresses separated by commas.
    patience_s
        Timeout of the first connection, seconds.
    credentials
        Certificate; None for an open bus.
    role
        Role of the credentials.
    of
        Bus whose connection is shared.

    Raises
    ------
    BusError
        If an address is malformed, or no router accepts the connection within ``patience_s``.
    """

    def __init__(
        self,
        robot: str,
        endpoint: str = DEFAULT_ROUTER,
        patience_s: float = PATIENCE_S,
        credentials: Credentials = None,
        *,
        role: str = "operator",
        of: "Bus | None" = None,
    ) -> None:
        if of is None:
            check_credentials(endpoint, credentials)
        self.robot = robot
        self.endpoint = endpoint
        self._of = of
        open_session = partial(open_client, endpoint, credentials)
        self._lanes: dict[Lane, Connection] = (
            of._lanes if of else {lane: Connection(open_session, patience_s) for lane in LANES}
        )
        self._echo: LaneEcho = of._echo if of else LaneEcho(role, self._lanes)
        #: By topic, with the time of the last message, monotonic seconds.
        self._publishers: dict[
            str, tuple[Declared[zenoh.Publisher | zenoh.ext.AdvancedPublisher], float]
        ] = {}
        self._matching: dict[str, Declared[zenoh.Publisher]] = {}
        self._held = Budget(HELD_BYTES)
        self._declared: list[tuple[Connection, Declared[Any]]] = []
        self._answering: list[threading.Thread] = []

    def of_robot(self, robot: str) -> "Bus":
        """Return the bus of another robot over the same connection; close it before this bus."""
        return Bus(robot, self.endpoint, of=self)

    @property
    def sessions(self) -> dict[Lane, zenoh.Session]:
        """The current sessions, by lane."""
        return {lane: connection.session for lane, connection in self._lanes.items()}

    def _declare(
        self, lane: Lane, make: Callable[[zenoh.Session], E], *, sends: bool = False
    ) -> Declared[E]:
        declared = self._lanes[lane].declare(make, sends=sends)
        self._declared.append((self._lanes[lane], declared))
        return declared

    # -- the lanes ---------------------------------------------------------------------------------

    def echo_every(self, period_s: float) -> None:
        """Set the period of the echoes between the lanes, seconds."""
        self._echo.every(period_s)

    def echo_age_s(self, *lanes: Lane) -> float:
        """Return the age of the oldest of some lanes' newest echoes, seconds."""
        return max(map(self._echo.age_s, lanes))

    def silent(self) -> tuple[Lane, ...]:
        """Return the lanes without a router or without a recent echo."""
        return self._echo.silent()

    def check(self) -> None:
        """Raise BusError if a lane stays silent although the router is connected.

        Only a new process restores such a lane.
        """
        deaf = self._echo.deaf()
        if deaf:
            raise BusError(
                f"lane {', '.join(deaf)}: no echo for {SILENT_S + DEAF_S:g} s, "
                f"though {self.endpoint} is connected; "
                "this process ends and must be started again"
            )

    def connected(self) -> bool:
        """Return whether every lane has a router that echoes."""
        return not self.silent()

    def wait_connected(self, timeout_s: float) -> None:
        """Wait for the router; raise BusError after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not self.connected():
            if time.monotonic() > deadline:
                raise BusError(f"no router at {self.endpoint}; start the stack with `smal up`")
            time.sleep(0.02)

    # -- messages ----------------------------------------------------------------------------------

    def publish(self, message: Message) -> None:
        """Publish a message on its topic.

        During an outage of the router it is lost, unless its topic is recorded: then it is kept for
        ``topics.KEPT_S`` and replayed to subscribers with ``replay``.
        """
        topic = TOPICS[message.topic_name]
        publisher, _ = self._publishers.get(topic.name) or (None, 0.0)
        if publisher is None:
            publisher = self._lanes[topic.outgoing].declare(
                partial(self.declare_publisher, topic), sends=True
            )
        self._publishers[topic.name] = publisher, time.monotonic()
        publisher.entity.put(payload := encode(message), attachment=checksum(payload))

    def forget(self) -> None:
        """Release the kept messages of silent publishers; call it on the publishing thread."""
        for name, (publisher, sent_s) in [*self._publishers.items()]:
            if time.monotonic() - sent_s > KEPT_S:
                del self._publishers[name]
                self._lanes[TOPICS[name].outgoing].let_go(publisher)

    def has_listeners(self, topic: Topic) -> bool:
        """Return whether a topic has subscribers, to skip costly messages without any."""
        # A separate publisher: Zenoh's advanced publisher does not report subscribers.
        if topic.name not in self._matching:
            key = topic.key(self.robot)
            self._matching[topic.name] = self._declare(
                topic.outgoing, lambda session: session.declare_publisher(key), sends=True
            )
        # Zenoh's types declare bool, but it is an object, which is always true.
        status: object = self._matching[topic.name].entity.matching_status
        return cast("zenoh.MatchingStatus", status).matching

    def declare_publisher(
        self, topic: Topic, session: zenoh.Session | None = None
    ) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        """Declare the publisher of a topic, in the current session by default."""
        session = session or self.sessions[topic.outgoing]
        key = topic.key(self.robot)
        options = {
            "encoding": zenoh.Encoding(encoding_of(topic.message)),
            **zenoh_quality(quality(topic)),
        }
        if not topic.recorded:
            return session.declare_publisher(key, **options)
        block = zenoh.CongestionControl.BLOCK
        replies = zenoh.ext.RepliesConfig(
            congestion_control=block, priority=REPLAY_PRIORITY, express=False
        )
        missed = zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            **options,
            cache=zenoh.ext.CacheConfig(topic.kept, replies_config=replies),
            sample_miss_detection=missed,
            publisher_detection=True,
        )

    def subscribe(
        self, topic: Topic, take: Take, refused: Refused = lambda _: None, *, replay: bool = False
    ) -> None:
        """Call ``take`` for every sample of a topic, on the bus's thread.

        Parameters
        ----------
        topic
            Topic to subscribe to.
        take
            Called with payload, encoding and transit time in seconds by the clocks of both
            machines, or None. It must return at once.
        refused
            Called with the reason for each invalid sample, and its sender.
        replay
            Whether to receive, in order, the messages of the last ``topics.KEPT_S`` and those lost
            on the way. For records only: a robot must not move by old commands.
        """
        key = topic.key(self.robot)

        def on_sample(sample: zenoh.Sample) -> None:
            encoding = str(sample.encoding)
            put = sample.kind == _PUT
            summed = sample.attachment
            size = len(sample.payload) + (0 if summed is None else len(summed))
            why = flaw(key, topic.message, str(sample.key_expr), size, encoding, put=put)
            payload = b"" if why else sample.payload.to_bytes()
            if why := why or (damage(payload, summed.to_bytes()) if summed is not None else None):
                refused(f"{why}; {_origin(sample)}")
                return
            stamp = sample.timestamp
            take(
                payload,
                encoding,
                None if stamp is None else time.time() - stamp.get_time().timestamp(),
            )

        if replay:
            connection = self._lanes[topic.lane]
            both = subscribe_whole(connection, key, on_sample, refused, self._held)
            self._declared += [(connection, declared) for declared in both]
        else:
            self._declare(
                topic.lane, lambda session: session.declare_subscriber(key, in_order(on_sample))
            )

    def listen(
        self, keys: str, take: Callable[[str, bytes, str], None], *, lane: Lane = "ordinary"
    ) -> None:
        """Call ``take(key, payload, encoding)`` for each sample; BusError for an invalid key."""

        def on_sample(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))

        try:
            self._declare(
                lane, lambda session: session.declare_subscriber(keys, in_order(on_sample))
            )
        except zenoh.ZError as error:
            # Without the location in Zenoh's source.
            raise BusError(str(error).partition(" at /")[0]) from None

    # -- liveliness --------------------------------------------------------------------------------

    def stand(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token and return the function that withdraws it.

        The token uses another session than the query of `look`. Therefore a process sees its own
        token only when the router has it, and with it all earlier tokens.
        """
        lane = self._lanes["urgent"]
        return partial(
            lane.let_go, lane.declare(lambda session: session.liveliness().declare_token(key))
        )

    def look(self, keys: str, timeout_s: float) -> frozenset[str]:
        """Return the keys of all liveliness tokens; empty without a router or a session.

        Queries, unlike subscriptions, bound the load by a flood of tokens.
        """
        # Zenoh drops a callback under a lock, which other threads wait for while they hold the GIL.
        channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_MOST_TOKENS)
        try:
            replies = (
                self._lanes["ordinary"].session.liveliness().get(keys, channel, timeout=timeout_s)
            )
        except zenoh.ZError:  # The session was closed, by this process or for a new session.
            return frozenset()
        return frozenset(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def answer(self, key: str, tell: Callable[[], Strict | None]) -> None:
        """Answer queries at a key on the bus's thread; None leaves a query unanswered."""

        def on_query(query: zenoh.Query) -> None:
            with query:
                message = tell()
                if message is not None:
                    query.reply(key, message.model_dump_json().encode(), encoding=JSON_ENCODING)

        callback = zenoh.handlers.Callback(on_query, indirect=False)
        self._declare("ordinary", lambda session: session.declare_queryable(key, callback))

    def ask(self, keys: str, take: Callable[[str, bytes], None], timeout_s: float) -> None:
        """Query some keys and call ``take(key, payload)`` for each answer, on the bus's thread."""

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_RPC_BYTES:
                take(str(reply.ok.key_expr), reply.ok.payload.to_bytes())

        self._lanes["ordinary"].session.get(
            keys,
            zenoh.handlers.Callback(on_reply, indirect=False),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            timeout=timeout_s,
            priority=_CALL_PRIORITY,
        )

    # -- calls -------------------------------------------------------------------------------------

    def serve(
        self,
        service: str,
        verb: str,
        answer: Callable[[bytes, Callable[[Strict], None]], None],
        refused: Refused = lambda _: None,
    ) -> None:
        """Answer calls by ``answer(request_json, reply)``, on a separate thread.

        ``answer`` can pass ``reply`` to other threads. A ``Failure`` given to ``reply`` raises an
        error at the caller. Requests that are too large, or not for this service alone, fail
        likewise, and ``refused`` receives the reason.
        """
        key = rpc_key(self.robot, service, verb)

        def on_query(query: zenoh.Query) -> None:
            def reply(message: Strict) -> None:
                payload = message.model_dump_json().encode()
                with query:
                    if isinstance(message, Failure):
                        query.reply_err(payload, encoding=JSON_ENCODING)
                    else:
                        query.reply(key, payload, encoding=JSON_ENCODING)

            payload = query.payload
            if (
                why := flaw(key, None, str(query.key_expr), 0 if payload is None else len(payload))
            ) is not None:
                refused(why)
                reply(Failure(error=why))
                return
            try:
                answer(b"{}" if payload is None else payload.to_bytes(), reply)
            except Exception:
                # The logged traceback keeps a reference to the query.
                query.drop()
                _logger.exception("a handler on the bus's thread failed")

        def answer_all(queryable: zenoh.Queryable[Any]) -> None:
            for query in queryable:
                began_s = time.thread_time()
                on_query(query)
                # The last reference decides: without one, Zenoh ends the call without an answer.
                del query
                time.sleep((1.0 / CALLS_SHARE - 1.0) * (time.thread_time() - began_s))

        # Calls wait outside of Python, where they take no time from the loop that drives: any
        # watcher may send ten thousand status calls a second.
        def take_calls(session: zenoh.Session) -> zenoh.Queryable[Any]:
            calls: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(
                WAITING_CALLS
            )
            queryable = session.declare_queryable(key, calls, complete=True)
            thread = threading.Thread(
                target=answer_all, args=(queryable,), name=f"calls of {key}", daemon=True
            )
            self._answering = [*(one for one in self._answering if one.is_alive()), thread]
            thread.start()
            return queryable

        self._declare("ordinary", take_calls)

    def call(
        self, service: str, verb: str, request: Strict, reply_type: type[R], timeout_s: float = 10.0,
        patience_s: float | None = None,
    ) -> R:  # fmt: skip
        """Call a service and return its validated reply.

        Parameters
        ----------
        service, verb
            Name of the queryable.
        request
            Request, sent as JSON.
        reply_type
            Class of the reply.
        timeout_s
            Time limit of one attempt, seconds.
        patience_s
            How long to retry while no instance serves the robot; by default the time that a move
            between instances takes.

        Raises
        ------
        RpcError
            If the service refuses, does not answer in time, or sends an invalid reply.
        """
        key = rpc_key(self.robot, service, verb)
        began_s = time.monotonic()
        if patience_s is None:
            patience_s = MOVE_S if service in SERVICES and SERVICES[service].grouped else 0.0
        while (
            reply := self._ask(key, request, timeout_s)
        ) is None and time.monotonic() < began_s + patience_s:
            time.sleep(_AGAIN_S)
        if reply is None:
            raise RpcError(
                f"{service} {verb}: no answer; is the service running for robot {self.robot}? "
                f"(router {self.endpoint})"
            )
        result = reply.result
        at = key
        put = True
        if isinstance(result, zenoh.Sample):
            at = str(result.key_expr)
            put = result.kind == _PUT
        if (why := flaw(key, None, at, len(result.payload), put=put)) is not None:
            raise RpcError(f"{service} {verb}: invalid reply: {why}")
        payload = result.payload.to_bytes()
        if not isinstance(result, zenoh.Sample):
            raise RpcError(f"{service} {verb}: {reason(payload)}")
        try:
            return reply_type.model_validate_json(payload)
        except ValidationError as error:
            raise RpcError(f"{service} {verb}: invalid reply: {describe(error)}") from None

    def _ask(self, key: str, request: Strict, timeout_s: float) -> zenoh.Reply | None:
        """Return the first reply to a call; None without a reply."""
        replies = self._lanes["ordinary"].session.get(
            key,
            # Room for one reply, so that a thousand replies cannot fill the memory.
            zenoh.handlers.FifoChannel(1),
            payload=request.model_dump_json().encode(),
            encoding=JSON_ENCODING,
            timeout=timeout_s,
            priority=_CALL_PRIORITY,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return next(iter(replies), None)

    def close(self) -> None:
        """Withdraw every declaration and disconnect."""
        for name in self._publishers:
            self._declared.append((self._lanes[TOPICS[name].outgoing], self._publishers[name][0]))
        while self._declared:
            connection, declared = self._declared.pop()
            connection.let_go(declared)
        if self._of is None:
            self._echo.close()
            for connection in self._lanes.values():
                connection.close()
        # Each thread ends with its queryable. A thread that wakes in Zenoh while Python finalizes
        # aborts the process.
        for thread in self._answering:
            if thread is not threading.current_thread():
                thread.join(_LAST_ANSWER_S)


def _origin(sample: zenoh.Sample) -> str:
    """Describe the sender of a sample, if known; routers stamp samples without a timestamp."""
    if sample.source_info is not None:
        return f"sent by {sample.source_info.source_id.zid}"
    return (
        "sender unknown" if sample.timestamp is None else f"stamped by {sample.timestamp.get_id()}"
    )
