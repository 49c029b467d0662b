"""The wire between processes: Zenoh's sessions, publishers, subscribers, queryables and calls.

This is the only file that imports zenoh, and the one place for its configuration.
"""

from __future__ import annotations

import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Final, cast

import zenoh
import zenoh.ext

from schemas.codec import encoding_of, printable
from schemas.topics import KEPT_S, Topic
from services.kit.access import access_control
from services.kit.credentials import Certificate, Credentials, Password, encrypted, others_reach, why_refused
from services.kit.heap import keep_freed_memory
from services.kit.replay import Budget, Replay
from services.kit.wire import LARGEST_BYTES, MAX_RPC_BYTES, Answer, BusError, Refused, Serve, Take, Wire, flaw

DEFAULT_ROUTER: Final = "tcp/127.0.0.1:7447"
#: Others that Zenoh knows are left out: who asks for them can hold up everybody, or is not bound by a certificate.
ENDPOINT_PATTERN: Final = r"(?:tcp|tls)/([^\s/]+):(\d{1,5})"
#: How long one attempt to reach the router lasts; between two attempts a signal is noticed.
ATTEMPT_MS: Final = 500
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
#: What a message takes beside its payload: key, encoding and Zenoh's own fields are 300 bytes.
_OVERHEAD_BYTES: Final = 1024
LINK_BYTES: Final = LARGEST_BYTES + _OVERHEAD_BYTES
#: After so long a silence a link is dead, and so is one that has not said who it is.
LEASE_MS: Final = 2000
#: Sessions that a router takes: with Zenoh's thousand, each with messages that are not yet whole, it would run out of
#: memory. Every process has two, those of a stack 14; as many again are counted while dead links have their lease. The
#: rest is for 18 programs of people.
MAX_SESSIONS: Final = 64
#: Calls of one key that wait; where more come, nobody answers the oldest.
WAITING_CALLS: Final = 32
#: Most of a processor's time that answering the calls of one key takes.
CALLS_SHARE: Final = 0.1
#: A call that is being answered at the end is waited for so long.
_LAST_ANSWER_S: Final = 1.0
#: Largest call that a router passes on, for who is called to refuse it by name; `WAITING_CALLS` of them may wait.
_CALL_BYTES: Final = 2 * MAX_RPC_BYTES
#: Of calls: ahead of images and of what is replayed.
_CALL_PRIORITY: Final = zenoh.Priority.INTERACTIVE_LOW
#: How a publisher that keeps samples calls itself: its session, and its number there.
_SENDER_PATTERN: Final = r"[0-9a-f]{1,32}/[0-9]+(?=/|$)"
_PUT: Final = zenoh.SampleKind.PUT
JSON_ENCODING: Final = zenoh.Encoding("application/json")
_logger = logging.getLogger("bus")


def settings_of(mode: str, endpoint: str, credentials: Credentials) -> dict[str, object]:
    """Return what a router, or a client of one, tells Zenoh, by the paths of Zenoh's own settings."""
    where = "listen" if mode == "router" else "connect"
    if mode == "client":
        endpoint = _named(endpoint)
    settings: dict[str, object] = {
        "mode": mode,
        f"{where}/endpoints": [endpoint],
        # Nothing is found by multicast: a robot must never be steered by a stranger's stack on the same network.
        "scouting/multicast/enabled": False,
        # A router would otherwise wait half a second for the scouting that is off.
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        "transport/shared_memory/enabled": False,
        # What is larger is dropped while it comes in, and not passed on: otherwise a message takes up to 1 GiB here.
        "transport/link/rx/max_message_size": LINK_BYTES,
        # Every sample tells when it was sent: the receiver's metrics want it, and so does replay.
        "timestamping/enabled": True,
        # A full-size frame is 40 fragments; a machine busy with rendering may not drain them within the default 50 ms.
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
        # Nor is the default of 1 ms enough for a few commands in a row: a busy machine dropped 1 in 100 of them.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100_000,
        # Episode events wait rather than be dropped. A client that does not read must not hold up everybody else for
        # the default of 5 s: its connection is closed, and it may connect again.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 250_000,
    }
    if mode == "router":
        settings |= {"transport/unicast/max_sessions": MAX_SESSIONS, "transport/unicast/accept_timeout": LEASE_MS}
        settings["low_pass_filter"] = [
            {"id": "calls", "messages": ["query"], "flows": ["ingress"], "key_exprs": ["**"], "size_limit": _CALL_BYTES}
        ]
    else:
        # Only the first connection: after an outage it is made again for as long as it takes. Without this limit
        # `zenoh.open` blocks for ever where there is no router, deaf to signals.
        settings["connect/timeout_ms"] = ATTEMPT_MS
        settings["connect/exit_on_failure"] = False
        settings["connect/retry"] = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    if isinstance(credentials, Certificate):
        settings |= {
            "transport/link/tls/root_ca_certificate": str(credentials.ca),
            f"transport/link/tls/{where}_certificate": str(credentials.certificate),
            f"transport/link/tls/{where}_private_key": str(credentials.key),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/verify_name_on_connect": True,
            "transport/link/tls/close_link_on_expiration": True,
        }
    elif isinstance(credentials, Password):
        settings |= {
            "transport/auth/usrpwd/user": credentials.user,
            "transport/auth/usrpwd/password": credentials.password,
        }
        if mode == "router":
            settings["transport/auth/usrpwd/dictionary_file"] = str(credentials.dictionary)
    return settings


def _named(endpoint: str) -> str:
    """Name what a client goes to: every address of this machine is one to listen on, which no certificate has."""
    return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/localhost:", endpoint)


def _configuration(settings: dict[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def router_settings(endpoint: str, robot: str, credentials: Credentials) -> dict[str, object]:
    """Return what a router tells Zenoh: who comes with credentials may do what the table of services says."""
    settings = settings_of("router", endpoint, credentials)
    if credentials is not None:
        settings["access_control"] = access_control(robot)
        settings["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
    return settings


def zenohd_configuration(endpoint: str, robot: str, credentials: Credentials) -> dict[str, object]:
    """Return what makes Eclipse's own router, a program of its own, the same router as ``Router``."""
    tree: dict[str, Any] = {}
    for path, value in router_settings(endpoint, robot, credentials).items():
        *folders, last = path.split("/")
        at = tree
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return tree


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return the two parts of a router's address.

    Raises
    ------
    BusError
        When the address is malformed; Zenoh would try an impossible one for ever.
    """
    match = re.fullmatch(ENDPOINT_PATTERN, endpoint)
    if match is None or int(match[2]) > 65535:
        form = f"tcp/<host>:<port> or tls/<host>:<port>, for example {DEFAULT_ROUTER}"
        raise BusError(f"router address {endpoint[:100]!r}: expected {form}")
    return match[1].strip("[]"), int(match[2])


def check_credentials(endpoint: str, credentials: Credentials) -> None:
    """Check that an address is of the kind that credentials are for.

    Raises
    ------
    BusError
        When it is encrypted and they are no certificate, or the other way round.
    """
    if encrypted(endpoint) and not isinstance(credentials, Certificate):
        raise BusError(f"{endpoint} needs a certificate: give --secure DIR, or set SMAL_TLS_CA, _CERT and _KEY")
    if isinstance(credentials, Certificate) and not encrypted(endpoint):
        raise BusError(f"{endpoint} is not encrypted: with a certificate give an address that begins with tls/")


def _open_client(endpoint: str, credentials: Credentials, patience_s: float) -> zenoh.Session:
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return zenoh.open(_configuration(settings_of("client", endpoint, credentials)))
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise BusError(_why_no_router(endpoint, credentials)) from None


def _why_no_router(endpoint: str, credentials: Credentials) -> str:
    """Tell a router that refuses us, for whatever reason of its own, from none."""
    try:
        socket.create_connection(host_and_port(endpoint), 1.0).close()
    except OSError:
        return f"no router at {endpoint}; start the stack with `smal up`"
    full = f"is full (it takes {MAX_SESSIONS} sessions, two of each program)"
    if isinstance(credentials, Certificate):
        refused = why_refused(credentials, *host_and_port(_named(endpoint)))
        return refused or f"what listens at {endpoint} is no router that encrypts, does not answer, or {full}"
    who = "who gives this password" if isinstance(credentials, Password) else "without a certificate or a password"
    return f"what listens at {endpoint} is no router, or takes nobody in {who}, or {full}"


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
            self._session = zenoh.open(_configuration(router_settings(endpoint, robot, credentials)))
        except zenoh.ZError as error:
            reason = "the port is in use" if "in use" in str(error) else str(error).partition(" at /")[0][:200]
            raise BusError(
                f"cannot listen on {endpoint}: {reason}; stop what uses it, or choose another port"
            ) from None

    def close(self) -> None:
        """Stop routing."""
        self._session.close()


class ZenohWire(Wire):
    """One process's connection to a Zenoh router.

    Commands travel in a session of their own, so that no image can stand before them in a queue.

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
        self.sessions = {urgent: _open_client(endpoint, credentials, patience_s) for urgent in (False, True)}
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._held = Budget(HELD_BYTES)
        self._declared: list[zenoh.Subscriber[None] | zenoh.ext.AdvancedSubscriber[None] | zenoh.Queryable[Any]] = []
        self._answering: list[threading.Thread] = []

    def connected(self) -> bool:
        """Whether both sessions have a router."""
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
        session, key = self.sessions[topic.urgent], topic.key(self._robot)
        encoding = zenoh.Encoding(encoding_of(topic.message))
        congestion = zenoh.CongestionControl.BLOCK if topic.reliable else zenoh.CongestionControl.DROP
        priority = _priority(topic)
        if not topic.recorded:
            return session.declare_publisher(
                key, encoding=encoding, congestion_control=congestion, priority=priority, express=topic.urgent
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
            express=topic.urgent,
            cache=zenoh.ext.CacheConfig(topic.kept, replies_config=replies),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
            publisher_detection=True,
        )

    def subscribe(self, topic: Topic, take: Take, refused: Refused, *, replay: bool) -> None:
        """Call ``take`` for every sample of a topic, with ``replay`` also for what got lost in an outage."""
        key, session = topic.key(self._robot), self.sessions[topic.urgent]

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

    def listen(self, keys: str, take: Callable[[str, bytes, str], None], *, urgent: bool) -> None:
        """Call ``take(key, payload, encoding)`` for every sample on matching keys."""

        def on_sample(sample: zenoh.Sample) -> None:
            take(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))

        try:
            self._declared.append(self.sessions[urgent].declare_subscriber(keys, _in_order(on_sample)))
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
        queryable = self.sessions[False].declare_queryable(key, calls, complete=True)
        self._declared.append(queryable)
        thread = threading.Thread(target=answer_all, name=f"calls of {key}", daemon=True)
        self._answering.append(thread)
        thread.start()

    def call(self, key: str, request: bytes, timeout_s: float) -> Answer | None:
        """Call a key and wait for the answer."""
        replies = self.sessions[False].get(
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


def _priority(topic: Topic) -> zenoh.Priority:
    """Return a topic's queue. What waits must not wait behind images: a slow link would then be closed for them.

    And nothing must wait behind what is replayed.
    """
    if topic.urgent:
        return zenoh.Priority.REAL_TIME
    return zenoh.Priority.INTERACTIVE_LOW if topic.reliable else zenoh.Priority.DATA_HIGH


def _origin(sample: zenoh.Sample) -> str:
    """Say whose a sample is, as far as that is said; a router stamps what came without a time."""
    if sample.source_info is not None:
        return f"sent by {sample.source_info.source_id.zid}"
    return "stamped by nobody" if sample.timestamp is None else f"stamped by {sample.timestamp.get_id()}"


def _in_order(on_sample: Callable[[zenoh.Sample], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
    """Make a callback that runs on the session's thread: one thread for each would lose the order between topics."""
    return zenoh.handlers.Callback(on_sample, indirect=False)
