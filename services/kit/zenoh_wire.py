"""The wire between processes: Zenoh's sessions, publishers, subscribers, queryables and calls.

This is the only file that imports zenoh; what it is told stands in ``zenoh_settings``.
"""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Final, cast

import zenoh
import zenoh.ext

from schemas.codec import encoding_of, printable
from schemas.topics import KEPT_S, LANES, Lane, Topic
from services.kit.credentials import Credentials, others_reach, why_refused
from services.kit.heap import keep_freed_memory
from services.kit.replay import Budget, Replay
from services.kit.wire import Answer, BusError, Refused, Serve, Take, flaw
from services.kit.zenoh_settings import (
    CLIENT_THREADS,
    DEFAULT_ROUTER,
    MAX_SESSIONS,
    ROUTER_THREADS,
    check_credentials,
    host_and_port,
    named,
    quality,
    router_settings,
    runtime,
    settings_of,
)

#: How long a process waits for a router that is perhaps just starting.
PATIENCE_S: Final = 10.0
#: A publisher that was silent tells at most this long after its last sample how many there were, so that a subscriber
#: that missed it notices.
HEARTBEAT_S: Final = 0.25
#: Priority of replayed samples: that of the message by which Zenoh ends a reply. With a lower one that would overtake
#: them on a busy machine, and the rest be lost.
REPLAY_PRIORITY: Final = zenoh.Priority.DATA
#: How long a sender that does not answer can hold up its own samples.
REPLAY_TIMEOUT_S: Final = 10.0
#: Bytes that samples may take while they wait for what their senders kept, over all topics: for ten seconds, six
#: megabytes a second, which is frames as JPEG at 10 Hz and all else.
HELD_BYTES: Final = 64 << 20
#: Calls of one key that wait; where more come, nobody answers the oldest.
WAITING_CALLS: Final = 32
#: Most of a processor's time that answering the calls of one key takes.
CALLS_SHARE: Final = 0.1
#: Of calls: ahead of images and of what is replayed.
_CALL_PRIORITY: Final = zenoh.Priority.INTERACTIVE_LOW
#: A call that is being answered at the end is waited for so long.
_LAST_ANSWER_S: Final = 1.0
#: How a publisher that keeps samples calls itself: its session, and its number there.
_SENDER_PATTERN: Final = r"[0-9a-f]{1,32}/[0-9]+(?=/|$)"
_PUT: Final = zenoh.SampleKind.PUT
_PRIORITY: Final = {
    "real_time": zenoh.Priority.REAL_TIME,
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "interactive_low": zenoh.Priority.INTERACTIVE_LOW,
    "data_high": zenoh.Priority.DATA_HIGH,
}
_CONGESTION: Final = {"block": zenoh.CongestionControl.BLOCK, "drop": zenoh.CongestionControl.DROP}
JSON_ENCODING: Final = zenoh.Encoding("application/json")
#: Zenoh's own variable for how many threads it has for what, in a process.
_RUNTIME: Final = "ZENOH_RUNTIME"
_OPENING: Final = threading.Lock()
_logger = logging.getLogger("bus")


def _open(settings: dict[str, object], threads: int) -> zenoh.Session:
    """Open a session; the first one of a process decides how many threads take in what comes.

    That is told to Zenoh by the environment, which is not for the processes that this one starts.
    """
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with _OPENING:
        before = os.environ.get(_RUNTIME)
        os.environ[_RUNTIME] = before or runtime(threads)
        try:
            return zenoh.open(config)
        finally:
            if before is None:
                del os.environ[_RUNTIME]


def _open_client(endpoint: str, credentials: Credentials, patience_s: float) -> zenoh.Session:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return _open(settings_of("client", endpoint, credentials), CLIENT_THREADS)
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise BusError(_why_no_router(endpoint, credentials)) from None


def _why_no_router(endpoint: str, credentials: Credentials) -> str:
    """Tell a router that refuses us, for whatever reason of its own, from none."""
    try:
        socket.create_connection(host_and_port(endpoint), 1.0).close()
    except OSError:
        return f"no router at {endpoint}; start the stack with `smal up`"
    full = f"is full (it takes {MAX_SESSIONS} sessions, {len(LANES)} of each program)"
    if credentials is not None:
        refused = why_refused(credentials, *host_and_port(named(endpoint)))
        return refused or f"what listens at {endpoint} is no router that encrypts, does not answer, or {full}"
    return f"what listens at {endpoint} is no router, or takes nobody in without a certificate, or {full}"


class Router:
    """A Zenoh router in this process.

    Parameters
    ----------
    endpoint
        Where to listen, for example ``tcp/127.0.0.1:7447``.
    credentials
        Who it is to its clients. With them it lets in who has credentials, and these may do what their role may with
        ``robot``; without them everybody may do everything.
    robot
        Whose bus it is, where there are credentials.
    insecure
        Whether it may listen without credentials where other machines reach it.

    Raises
    ------
    BusError
        When the endpoint is malformed, its port is taken, or strangers would get in.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ROUTER,
        credentials: Credentials = None,
        robot: str = "",
        *,
        insecure: bool = False,
    ) -> None:
        host, _ = host_and_port(endpoint)
        check_credentials(endpoint, credentials)
        if credentials is None and not insecure and others_reach(host):
            raise BusError(
                f"{endpoint} can be reached from other machines, and whoever reaches it could drive the robot: "
                "give --secure DIR (`smal secure init` makes it), or --insecure"
            )
        keep_freed_memory()
        try:
            self._session = _open(router_settings(endpoint, robot, credentials), ROUTER_THREADS)
        except zenoh.ZError as error:
            reason = "the port is in use" if "in use" in str(error) else str(error).partition(" at /")[0][:200]
            raise BusError(
                f"cannot listen on {endpoint}: {reason}; stop what uses it, or choose another port"
            ) from None

    def close(self) -> None:
        """Stop routing."""
        self._session.close()


class ZenohWire:
    """One process's connection to a Zenoh router.

    Each lane is a session of its own: no image can stand before a command in a queue, and nothing before a stop.

    Parameters
    ----------
    robot, endpoint
        Robot id and the router's address; after an outage the connection is made again in the background.
    patience_s
        How long to wait for the router.
    credentials
        Who this is to the router.

    Raises
    ------
    BusError
        When the address is malformed, or no router is there within ``patience_s`` that lets us in.
    """

    def __init__(
        self, robot: str, endpoint: str, patience_s: float = PATIENCE_S, credentials: Credentials = None
    ) -> None:
        host_and_port(endpoint)
        check_credentials(endpoint, credentials)
        keep_freed_memory()
        self._robot = robot
        self.sessions = {lane: _open_client(endpoint, credentials, patience_s) for lane in LANES}
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._held = Budget(HELD_BYTES)
        self._declared: list[zenoh.Subscriber[None] | zenoh.ext.AdvancedSubscriber[None] | zenoh.Queryable[Any]] = []
        self._answering: list[threading.Thread] = []

    def connected(self) -> bool:
        """Whether every session has a router."""
        return all(session.info.routers_zid() for session in self.sessions.values())

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send the bytes of a message; in an outage what is not recorded is lost."""
        self._publisher(topic).put(payload)

    def has_listeners(self, topic: Topic) -> bool:
        """Whether anybody takes a topic, as far as the router has told yet."""
        publisher = self._publisher(topic)
        assert isinstance(publisher, zenoh.Publisher)  # noqa: S101 - of topics that are not recorded
        # Zenoh's types say bool; it is an object, and as such always true.
        status: object = publisher.matching_status
        return cast("zenoh.MatchingStatus", status).matching

    def _publisher(self, topic: Topic) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        publisher = self._publishers.get(topic.name)
        if publisher is None:
            publisher = self._publishers[topic.name] = self.declare_publisher(topic)
        return publisher

    def declare_publisher(self, topic: Topic) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        """Declare the publisher that a topic asks for."""
        session, key = self.sessions[topic.lane], topic.key(self._robot)
        encoding = zenoh.Encoding(encoding_of(topic.message))
        how = quality(topic)
        congestion, priority = _CONGESTION[how.congestion_control], _PRIORITY[how.priority]
        if not topic.recorded:
            return session.declare_publisher(
                key, encoding=encoding, congestion_control=congestion, priority=priority, express=how.express
            )
        replies = zenoh.ext.RepliesConfig(
            congestion_control=zenoh.CongestionControl.BLOCK, priority=REPLAY_PRIORITY, express=False
        )
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=encoding,
            congestion_control=congestion,
            priority=priority,
            express=how.express,
            cache=zenoh.ext.CacheConfig(topic.kept, replies_config=replies),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
            publisher_detection=True,
        )

    def subscribe(self, topic: Topic, take: Take, refused: Refused, *, replay: bool) -> None:
        """Call ``take`` for every sample of a topic, with ``replay`` also for what got lost in an outage."""
        key, session = topic.key(self._robot), self.sessions[topic.lane]

        def on_sample(sample: zenoh.Sample) -> None:
            payload, encoding, put = sample.payload, str(sample.encoding), sample.kind == _PUT
            if (why := flaw(key, topic.message, str(sample.key_expr), len(payload), encoding, put=put)) is not None:
                refused(f"{why}; {_origin(sample)}")
                return
            stamp = sample.timestamp
            transit_s = None if stamp is None else time.time() - stamp.get_time().timestamp()
            take(payload.to_bytes(), encoding, transit_s)

        if replay:
            self._subscribe_replayed(session, key, on_sample, refused)
        else:
            self._declared.append(session.declare_subscriber(key, _in_order(on_sample)))

    def _subscribe_replayed(
        self, session: zenoh.Session, key: str, take: Callable[[zenoh.Sample], None], refused: Refused
    ) -> None:
        senders = f"{key}/@adv/pub"

        def ask(name: str) -> None:
            def on_reply(reply: zenoh.Reply) -> None:
                if reply.ok is not None and reply.ok.source_info is not None:
                    replay.replayed(name, reply.ok.source_info.source_sn, reply.ok)

            session.get(
                zenoh.Selector(f"{senders}/{name}/**", f"_time=[now(-{KEPT_S:g}s)..]"),
                zenoh.handlers.Callback(on_reply, lambda: replay.ended(name), indirect=False),
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=REPLAY_TIMEOUT_S,
            )

        def overdue(name: str) -> None:
            refused(f"{HELD_BYTES} bytes waited for what {name} kept; the rest of that is left out")

        replay = Replay(take, ask, self._held, overdue)

        def on_live(sample: zenoh.Sample) -> None:
            source = sample.source_info
            if source is None:  # of a stranger, who keeps nothing
                take(sample)
            else:
                name = f"{source.source_id.zid}/{source.source_id.eid}"
                replay.live(name, source.source_sn, sample, len(sample.payload))

        def on_sender(token: zenoh.Sample) -> None:
            if token.kind == _PUT:
                name = re.match(_SENDER_PATTERN, str(token.key_expr).removeprefix(f"{senders}/"))
                if name is None:
                    refused(f"no sender's sign of life: {printable(str(token.key_expr))}")
                else:
                    replay.met(name[0])

        # First the subscription: nothing is lost between what a sender kept and what it sends from then on. What gets
        # lost on the way, and in an outage, is noticed by its number, and asked for by Zenoh, in order.
        recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        self._declared += [
            zenoh.ext.declare_advanced_subscriber(session, key, _in_order(on_live), recovery=recovery),
            session.liveliness().declare_subscriber(f"{senders}/**", _in_order(on_sender), history=True),
        ]

    def listen(self, keys: str, take: Callable[[str, bytes, str], None], *, lane: Lane) -> None:
        """Call ``take(key, payload, encoding)`` for every sample on matching keys."""

        def on_sample(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))

        try:
            self._declared.append(self.sessions[lane].declare_subscriber(keys, _in_order(on_sample)))
        except zenoh.ZError as error:
            raise BusError(str(error).partition(" at /")[0]) from None  # without the place in Zenoh's source

    def serve(self, key: str, answer: Serve, refused: Refused) -> None:
        """Answer calls of a key, on a thread of its own."""

        def on_query(query: zenoh.Query) -> None:
            def reply(message: Answer) -> None:
                with query:
                    if message.failed:
                        query.reply_err(message.payload, encoding=JSON_ENCODING)
                    else:
                        query.reply(key, message.payload, encoding=JSON_ENCODING)

            payload = query.payload
            if (why := flaw(key, None, str(query.key_expr), 0 if payload is None else len(payload))) is not None:
                refused(why)
                reply(Answer.refusal(why))
                return
            try:
                answer(b"{}" if payload is None else payload.to_bytes(), reply)
            except Exception:
                # Who logs the error keeps its traceback, and with it the query.
                query.drop()
                _logger.exception("a handler on the bus's thread failed")

        def answer_all() -> None:
            for query in queryable:
                began_s = time.thread_time()
                on_query(query)
                # Whoever holds it now answers; otherwise its caller hears that nobody does.
                del query
                time.sleep((1.0 / CALLS_SHARE - 1.0) * (time.thread_time() - began_s))

        # What waits does so outside of Python, whose threads take turns: ten thousand calls of a status in a second,
        # which whoever looks at a robot may make, would otherwise take them from the loop that drives.
        calls: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(WAITING_CALLS)
        queryable = self.sessions["ordinary"].declare_queryable(key, calls, complete=True)
        self._declared.append(queryable)
        thread = threading.Thread(target=answer_all, name=f"calls of {key}", daemon=True)
        self._answering.append(thread)
        thread.start()

    def call(self, key: str, request: bytes, timeout_s: float) -> Answer | None:
        """Call a key and wait for the answer."""
        replies = self.sessions["ordinary"].get(
            key,
            # Room for one reply, and the first is taken: whoever answers a thousand times fills no memory.
            zenoh.handlers.FifoChannel(1),
            payload=request,
            encoding=JSON_ENCODING,
            timeout=timeout_s,
            priority=_CALL_PRIORITY,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            result = reply.result
            if isinstance(result, zenoh.Sample):
                why = flaw(key, None, str(result.key_expr), len(result.payload), put=result.kind == _PUT)
            else:
                why = flaw(key, None, key, len(result.payload))
            if why is not None:
                return Answer(f"unfit reply: {why}".encode(), failed=True)
            return Answer(result.payload.to_bytes(), failed=not isinstance(result, zenoh.Sample))
        return None

    def close(self) -> None:
        """Take back every declaration and close the sessions."""
        while self._declared:
            self._declared.pop().undeclare()
        for session in self.sessions.values():
            session.close()
        # Each ends with its queryable. One that woke in Zenoh while Python ends would end the process by an abort.
        for thread in self._answering:
            if thread is not threading.current_thread():
                thread.join(_LAST_ANSWER_S)


def _origin(sample: zenoh.Sample) -> str:
    """Say whose a sample is, as far as that is said; a router stamps what came without a time."""
    if sample.source_info is not None:
        return f"sent by {sample.source_info.source_id.zid}"
    return "stamped by nobody" if sample.timestamp is None else f"stamped by {sample.timestamp.get_id()}"


def _in_order(on_sample: Callable[[zenoh.Sample], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
    """Make a callback that runs on the session's thread: one thread for each would lose the order between topics."""
    return zenoh.handlers.Callback(on_sample, indirect=False)
