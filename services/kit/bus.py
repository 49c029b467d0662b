"""The bus: messages and calls over Zenoh between all at one router, or at several; ``wire`` says what to count on."""

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

PATIENCE_S: Final = 10.0  # How long a process waits for a router that is perhaps just starting.
#: How often a publisher tells how many samples there were, so that a subscriber that missed the last ones notices; also
#: when it has been silent for long, since the router may have been away meanwhile.
HEARTBEAT_S: Final = 0.25
#: Priority of replayed samples: that of the message by which Zenoh ends a reply. With a lower one that would overtake
#: them on a busy machine, and the rest be lost.
REPLAY_PRIORITY: Final = zenoh.Priority.DATA
#: Bytes that samples may take while they wait for what their senders kept, over all topics: for ten seconds, six
#: megabytes a second, which is frames as JPEG at 10 Hz and all else.
HELD_BYTES: Final = 64 << 20
WAITING_CALLS: Final = 32  # Calls of one key that wait; where more come, nobody answers the oldest.
CALLS_SHARE: Final = 0.1  # Most of a processor's time that answering the calls of one key takes.
MOVE_S: Final = 2.0  # Longest that a robot is without an instance, where one of several is gone.
_AGAIN_S: Final = 0.05  # From one call that nobody answers to the next.
_CALL_PRIORITY: Final = (
    zenoh.Priority.INTERACTIVE_LOW
)  # Of calls: ahead of images and of what is replayed.
_LAST_ANSWER_S: Final = 1.0  # A call that is being answered at the end is waited for so long.
_PUT: Final = zenoh.SampleKind.PUT
_MOST_TOKENS: Final = 1 << 16  # More than all sessions may declare at a router.
JSON_ENCODING: Final = zenoh.Encoding("application/json")
_logger = logging.getLogger("bus")
R = TypeVar("R", bound=Strict)
E = TypeVar("E", bound=Entity)


class RpcError(JobError):
    """A call was refused by the service or not answered."""


class Bus:
    """One process's connection to a router; the robot's id is part of every key.

    Each lane is a session of its own: no image can stand before a command in a queue, and nothing before a stop. After
    an outage the connection is made again in the background (`connection`), with the next of several routers where one
    is gone. Every lane proves that it carries both ways (`echo`). ``role`` is that of the credentials.

    Raises BusError when an address is malformed, or no router is there within ``patience_s`` that lets us in.
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
        #: By topic, with when something was last sent, monotonic seconds.
        self._publishers: dict[
            str, tuple[Declared[zenoh.Publisher | zenoh.ext.AdvancedPublisher], float]
        ] = {}
        self._matching: dict[str, Declared[zenoh.Publisher]] = {}
        self._held = Budget(HELD_BYTES)
        self._declared: list[tuple[Connection, Declared[Any]]] = []
        self._answering: list[threading.Thread] = []

    def of_robot(self, robot: str) -> "Bus":
        """Return another robot's bus by the same connection; close it before this one."""
        return Bus(robot, self.endpoint, of=self)

    @property
    def sessions(self) -> dict[Lane, zenoh.Session]:
        """The sessions of now, by lane."""
        return {lane: connection.session for lane, connection in self._lanes.items()}

    def _declare(
        self, lane: Lane, make: Callable[[zenoh.Session], E], *, sends: bool = False
    ) -> Declared[E]:
        declared = self._lanes[lane].declare(make, sends=sends)
        self._declared.append((self._lanes[lane], declared))
        return declared

    # -- the lanes --------------------------------------------------------------------------------------------------

    def echo_every(self, period_s: float) -> None:
        """Have the lanes send each other signs of life this often, seconds."""
        self._echo.every(period_s)

    def echo_age_s(self, *lanes: Lane) -> float:
        """Return how long ago the newest signs of life were sent that prove that all of some lanes work, seconds."""
        return max(map(self._echo.age_s, lanes))

    def silent(self) -> tuple[Lane, ...]:
        """Return the lanes that carry nothing: without a router, or without a recent echo from it."""
        return self._echo.silent()

    def check(self) -> None:
        """Raise BusError when a lane stays silent although the router is there: only a new process mends that."""
        deaf = self._echo.deaf()
        if deaf:
            raise BusError(
                f"lane {', '.join(deaf)}: no echo for {SILENT_S + DEAF_S:g} s, though {self.endpoint} is connected; "
                "this process ends and must be started again"
            )

    def connected(self) -> bool:
        """Whether every lane has a router, which echoes."""
        return not self.silent()

    def wait_connected(self, timeout_s: float) -> None:
        """Wait for the router; BusError where there is none within ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not self.connected():
            if time.monotonic() > deadline:
                raise BusError(f"no router at {self.endpoint}; start the stack with `smal up`")
            time.sleep(0.02)

    # -- messages -------------------------------------------------------------------------------------------------

    def publish(self, message: Message) -> None:
        """Send a message on its topic.

        During an outage of the router it is lost, but for the topics that are recorded: those are kept for
        ``topics.KEPT_S``, and subscribers with ``replay`` have them sent afterwards.
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
        """Let go of what is kept, where nothing was sent for longer than it is; on the thread that publishes."""
        for name, (publisher, sent_s) in [*self._publishers.items()]:
            if time.monotonic() - sent_s > KEPT_S:
                del self._publishers[name]
                self._lanes[TOPICS[name].outgoing].let_go(publisher)

    def has_listeners(self, topic: Topic) -> bool:
        """Whether anybody subscribes to a topic, as far as the router has told yet; for what is costly to make."""
        # Of its own: a publisher that keeps what it sends does not tell.
        if topic.name not in self._matching:
            key = topic.key(self.robot)
            self._matching[topic.name] = self._declare(
                topic.outgoing, lambda session: session.declare_publisher(key), sends=True
            )
        # Zenoh's types say bool; it is an object, and as such always true.
        status: object = self._matching[topic.name].entity.matching_status
        return cast("zenoh.MatchingStatus", status).matching

    def declare_publisher(
        self, topic: Topic, session: zenoh.Session | None = None
    ) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        """Declare the publisher that a topic asks for, in the session of now."""
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
        """Call ``take`` for every sample of a topic, on the bus's thread; it must return at once.

        It is given payload, encoding, and how many seconds it took by the clocks of both machines, or None. ``refused``
        is given why something is no such sample, and whose. With ``replay`` what was published in the last
        ``topics.KEPT_S``, and what gets lost, is sent in order: for what keeps a record, never for what moves a robot.
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
        """Call ``take(key, payload, encoding)`` for each sample on keys; BusError when these are no key expression."""

        def on_sample(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))

        try:
            self._declare(
                lane, lambda session: session.declare_subscriber(keys, in_order(on_sample))
            )
        except zenoh.ZError as error:
            raise BusError(
                str(error).partition(" at /")[0]
            ) from None  # without the place in Zenoh's source

    # -- who is there ---------------------------------------------------------------------------------------------

    def stand(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token, until what is returned is called or this process is gone.

        It comes from another session than the question of `look`: a process sees its own token only when the router has
        it, and then all tokens that the router had before.
        """
        lane = self._lanes["urgent"]
        return partial(
            lane.let_go, lane.declare(lambda session: session.liveliness().declare_token(key))
        )

    def look(self, keys: str, timeout_s: float) -> frozenset[str]:
        """Return the keys of all liveliness tokens that stand now; without a router, or a session, there are none.

        A process asks when it has time: a flood of tokens cannot outrun it, as it would if the router sent each one on.
        """
        # No callback: Zenoh ends one under a lock that other threads wait for while they hold Python's.
        channel: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_MOST_TOKENS)
        try:
            replies = (
                self._lanes["ordinary"].session.liveliness().get(keys, channel, timeout=timeout_s)
            )
        except zenoh.ZError:  # The session has been closed, by this process or for a new one.
            return frozenset()
        return frozenset(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def answer(self, key: str, tell: Callable[[], Strict | None]) -> None:
        """Answer every question at a key, on the bus's thread; with None the question stays without an answer."""

        def on_query(query: zenoh.Query) -> None:
            with query:
                message = tell()
                if message is not None:
                    query.reply(key, message.model_dump_json().encode(), encoding=JSON_ENCODING)

        callback = zenoh.handlers.Callback(on_query, indirect=False)
        self._declare("ordinary", lambda session: session.declare_queryable(key, callback))

    def ask(self, keys: str, take: Callable[[str, bytes], None], timeout_s: float) -> None:
        """Ask all that answer at some keys, and call ``take(key, payload)`` for each answer, on the bus's thread."""

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

    # -- calls ----------------------------------------------------------------------------------------------------

    def serve(
        self,
        service: str,
        verb: str,
        answer: Callable[[bytes, Callable[[Strict], None]], None],
        refused: Refused = lambda _: None,
    ) -> None:
        """Answer calls: ``answer(request_json, reply)`` runs on a thread of its own and may pass ``reply`` on.

        A ``Failure`` given to ``reply`` reaches the caller as an error; so does why a request is too large, or not for
        this service alone, of which ``refused`` is told.
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
                # Who logs the error keeps its traceback, and with it the query.
                query.drop()
                _logger.exception("a handler on the bus's thread failed")

        def answer_all(queryable: zenoh.Queryable[Any]) -> None:
            for query in queryable:
                began_s = time.thread_time()
                on_query(query)
                # Whoever holds it now answers; otherwise its caller hears that nobody does.
                del query
                time.sleep((1.0 / CALLS_SHARE - 1.0) * (time.thread_time() - began_s))

        # What waits does so outside of Python, whose threads take turns: ten thousand calls of a status in a second,
        # which whoever looks at a robot may make, would otherwise take them from the loop that drives.
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
        """Call a service; RpcError when it refuses, does not answer in time, or answers nonsense.

        Where nobody serves the robot it is asked again for so long; by default as a move between instances may take.
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
                f"{service} {verb}: no answer; is the service running for robot {self.robot}? (router {self.endpoint})"
            )
        result = reply.result
        at = key
        put = True
        if isinstance(result, zenoh.Sample):
            at = str(result.key_expr)
            put = result.kind == _PUT
        if (why := flaw(key, None, at, len(result.payload), put=put)) is not None:
            raise RpcError(f"{service} {verb}: unfit reply: {why}")
        payload = result.payload.to_bytes()
        if not isinstance(result, zenoh.Sample):
            raise RpcError(f"{service} {verb}: {reason(payload)}")
        try:
            return reply_type.model_validate_json(payload)
        except ValidationError as error:
            raise RpcError(f"{service} {verb}: malformed reply: {describe(error)}") from None

    def _ask(self, key: str, request: Strict, timeout_s: float) -> zenoh.Reply | None:
        """Return the first reply to a call; None where nobody answers."""
        replies = self._lanes["ordinary"].session.get(
            key,
            # Room for one reply, and the first is taken: whoever answers a thousand times fills no memory.
            zenoh.handlers.FifoChannel(1),
            payload=request.model_dump_json().encode(),
            encoding=JSON_ENCODING,
            timeout=timeout_s,
            priority=_CALL_PRIORITY,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return next(iter(replies), None)

    def close(self) -> None:
        """Take back every declaration and leave the router."""
        for name in self._publishers:
            self._declared.append((self._lanes[TOPICS[name].outgoing], self._publishers[name][0]))
        while self._declared:
            connection, declared = self._declared.pop()
            connection.let_go(declared)
        if self._of is None:
            self._echo.close()
            for connection in self._lanes.values():
                connection.close()
        # Each ends with its queryable. One that woke in Zenoh while Python ends would end the process by an abort.
        for thread in self._answering:
            if thread is not threading.current_thread():
                thread.join(_LAST_ANSWER_S)


def _origin(sample: zenoh.Sample) -> str:
    """Say whose a sample is, as far as that is said; a router stamps what came without a time."""
    if sample.source_info is not None:
        return f"sent by {sample.source_info.source_id.zid}"
    return (
        "stamped by nobody"
        if sample.timestamp is None
        else f"stamped by {sample.timestamp.get_id()}"
    )
