"""Zenoh sessions: a router in this process, clients, and all of their settings.

The settings cover the addresses of routers, the limits of routers and clients, and the transport of
each message.
"""

import ctypes
import json
import os
import re
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from schemas.topics import LANES, ROOT, TOPICS, Topic, echo_key, group_key, rpc_key
from services.kit.access import KEPT_KEYS, access_control
from services.kit.credentials import Credentials, encrypted, others_reach, why_refused
from services.kit.memory import keep_small
from services.kit.wire import LARGEST_BYTES, MAX_RPC_BYTES, BusError
from services.table import roles

DEFAULT_ROUTER: Final = "tcp/127.0.0.1:7447"
#: Zenoh's other protocols are excluded: some let a client block all others, or bypass certificates.
ENDPOINT_PATTERN: Final = r"(?:tcp|tls)/([^\s/@]+):(\d{1,5})"
# Time limit of one connection attempt; signals are handled between two attempts.
ATTEMPT_MS: Final = 800
#: Size of a message without its payload: key, encoding and Zenoh's own fields are 300 bytes.
_OVERHEAD_BYTES: Final = 1024
LINK_BYTES: Final = LARGEST_BYTES + _OVERHEAD_BYTES
# Silence after which a link is dead; also the time limit of its handshake.
LEASE_MS: Final = 2000
#: Silence after which clients leave one of several routers. With one attempt at the silent router,
#: which the next attempt can be, they reach another router within two seconds.
PAIR_LEASE_MS: Final = 1000
#: Maximum sessions of a router: Zenoh's thousand, each with partial messages, exhaust the memory.
#: Every process has one session per lane, a stack 24. As many again count while dead links have
#: their lease, and sessions from before an outage (`connection`). The rest allows 16 programs of
#: people.
MAX_SESSIONS: Final = 120
#: Sessions for each further robot of a fleet: its own process, a recorder, a page and one program of
#: a person.
SESSIONS_A_ROBOT: Final = 4 * len(LANES)
#: Receiving threads. A router has one per session, so that a sender that exceeds its receivers
#: delays only itself. A process on the bus has one more, for a robot's own router.
CLIENT_THREADS: Final = len(LANES) + 1
#: Threads for reconnections, each of which blocks there. With Zenoh's single thread the sessions of
#: a process wait for each other, and messages of the first sessions are lost (1.10.2, a frozen
#: router).
NET_THREADS: Final = 16
#: Maximum frequency of one call per session; a client that waits for answers is slower.
MOST_CALLS_HZ: Final = 10_000
# Maximum size of a call that a router passes on, so that the service can refuse it by name.
_CALL_BYTES: Final = 2 * MAX_RPC_BYTES
# Queries between instances; ``**`` does not match them.
_GROUPS: Final = f"{group_key('*', '*')}/**"
# Zenoh's variable for the numbers of its threads.
_RUNTIME: Final = "ZENOH_RUNTIME"
_LOG: Final = "RUST_LOG"  # Zenoh's variable for its log.
_OPENING: Final = threading.Lock()
_LIBC: Final = ctypes.CDLL(None)
_UNSPECIFIED: Final = bytes(16)  # A socket address of the family AF_UNSPEC.


class Quality(NamedTuple):
    """Transport of a message in Zenoh's terms.

    The priority selects the queue. Congestion control decides whether a message waits for room in
    it, and ``express`` whether it is sent without batching.
    """

    priority: str
    congestion_control: str
    express: bool


_ORDINARY: Final = Quality("data_high", "drop", express=False)
#: Echoes overtake all waiting messages. They are not express, so that several share a batch and none
#: waits for room on a full link.
ECHO_QUALITY: Final = Quality("real_time", "drop", express=False)


def quality(topic: Topic) -> Quality:
    """Return the transport of a topic.

    Reliable messages must not wait behind images, or a slow link is closed for them. No message
    must wait behind a replay. Emergency stops have a queue of their own.
    """
    if topic.lane == "ordinary":
        return Quality("interactive_low", "block", express=False) if topic.reliable else _ORDINARY
    return Quality(
        "real_time" if topic.lane == "stop" else "interactive_high", "drop", express=True
    )


def zenoh_quality(how: Quality) -> dict[str, Any]:
    """Return the options of a Zenoh publisher for a quality."""
    return {
        "congestion_control": getattr(zenoh.CongestionControl, how.congestion_control.upper()),
        "priority": getattr(zenoh.Priority, how.priority.upper()),
        "express": how.express,
    }


def _transport_rules() -> list[dict[str, object]]:
    """Return the router's transport rules, which override the senders' choice; the last match counts.

    Otherwise a sender could use the priority of an emergency stop, or have slower receivers
    disconnected by a sender that makes Zenoh wait.
    """
    rules: list[tuple[list[str], list[str], dict[str, object]]] = [
        # Answers inherit the priority of the question, and a replay must keep its own.
        (["query"], [*_everything("**"), _GROUPS], {"congestion_control": "drop"}),
        (["put", "delete"], _everything("**"), _ORDINARY._asdict()),
        (["put", "delete"], [echo_key("*", "*", "*", "*")], ECHO_QUALITY._asdict()),
    ]
    for how in sorted({quality(topic) for topic in TOPICS.values()} - {_ORDINARY}):
        names = [topic.name for topic in TOPICS.values() if quality(topic) == how]
        keys = [key for name in names for key in _everything(f"{ROOT}/*/{name}")]
        rules.append((["put", "delete"], keys, how._asdict()))
    return [
        {
            "id": str(number),
            "messages": messages,
            "flows": ["ingress"],
            "key_exprs": keys,
            "overwrite": overwrite,
        }
        for number, (messages, keys, overwrite) in enumerate(rules)
    ]


def _call_limits() -> list[dict[str, object]]:
    """Return the maximum frequency of each call per session; the router drops the rest on arrival.

    Each session counts separately, so that a flood of calls blocks only its sender. Messages have
    no such limit: Zenoh drops a message too soon after the last one, and of two that waited on a
    slow link it drops the newer.
    """
    served = sorted({name for role in roles().values() for name in role.serves})
    keys = [*(rpc_key("*", *name.split("/", 1)) for name in served), _GROUPS]
    rules = [{"key_expr": key, "freq": MOST_CALLS_HZ} for key in keys]
    return [{"id": "calls", "messages": ["query"], "flows": ["ingress"], "rules": rules}]


def _everything(key: str) -> list[str]:
    """Return a key, and the keys of its kept messages."""
    return [key, f"{key}/{KEPT_KEYS}"]


def settings_of(
    mode: str, endpoint: str, credentials: Credentials, peers: Sequence[str] = ()
) -> dict[str, object]:
    """Return the settings of a router or client, by the paths of Zenoh's configuration.

    A router connects to its peers, and retries for as long as it takes; if it is itself among the
    peers, only to those before it. If both sides connect, one can confuse the other's new link with
    the old one (1.10.2, issue 2806).
    """
    peers = list(peers)
    before = peers[: peers.index(endpoint)] if endpoint in peers else peers
    several = [named(one) for one in (before if mode == "router" else addresses(endpoint))]
    settings: dict[str, object] = {
        "mode": mode,
        **({"listen/endpoints": [endpoint]} if mode == "router" else {}),
        **({"connect/endpoints": several} if several else {}),
        # Without multicast, another stack on the same network can never move the robot.
        "scouting/multicast/enabled": False,
        # Otherwise a router waits half a second for the disabled scouting.
        "scouting/delay": 0,
        "transport/link/tx/lease": PAIR_LEASE_MS if peers else LEASE_MS,
        "transport/shared_memory/enabled": False,
        # Larger messages are dropped on arrival; otherwise one takes up to 1 GiB here.
        "transport/link/rx/max_message_size": LINK_BYTES,
        # Every sample has a timestamp, for the receiver's metrics and for replay.
        "timestamping/enabled": True,
        # Images, maps and features take many fragments; a busy machine can exceed the default of 50
        # ms.
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
        # With the default of 1 ms a busy machine dropped 1 in 100 commands that followed each
        # other.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100_000,
        # Episode events wait rather than be dropped. A client that does not read delays all others
        # by this time (default 5 s); then its connection is closed, and it can connect again.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 250_000,
    }
    if several:
        settings["connect/retry"] = {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 1.5,
        }
    if mode == "router":
        settings["transport/unicast/accept_timeout"] = LEASE_MS
        keys = ["**", _GROUPS]
        settings["low_pass_filter"] = [
            {
                "id": "calls",
                "messages": ["query"],
                "flows": ["ingress"],
                "key_exprs": keys,
                "size_limit": _CALL_BYTES,
            }
        ]
        settings["qos/network"] = _transport_rules()
        settings["downsampling"] = _call_limits()
    else:
        # For the first connection only; reconnections have no limit. Without it `zenoh.open` blocks
        # for ever without a router, and ignores signals.
        settings["connect/timeout_ms"] = ATTEMPT_MS
        settings["connect/exit_on_failure"] = False
        if len(several) > 1:
            # A frozen router accepts connections and never answers; after this time the next router
            # is tried.
            settings["transport/unicast/open_timeout"] = ATTEMPT_MS
    if credentials is not None:
        for side in ("listen", "connect"):  # A linked router both listens and connects.
            settings[f"transport/link/tls/{side}_certificate"] = str(credentials.certificate)
            settings[f"transport/link/tls/{side}_private_key"] = str(credentials.key)
        settings |= {
            "transport/link/tls/root_ca_certificate": str(credentials.ca),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/verify_name_on_connect": True,
            "transport/link/tls/close_link_on_expiration": True,
        }
    return settings


def named(endpoint: str) -> str:
    """Return the address for clients: localhost for wildcards, which no certificate names."""
    return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/localhost:", endpoint)


def most_sessions(robots: Sequence[str]) -> int:
    """Return the maximum sessions of a router for some robots, and its number of threads."""
    return MAX_SESSIONS + SESSIONS_A_ROBOT * max(len(robots) - 1, 0)


def router_settings(
    endpoint: str, robots: Sequence[str], credentials: Credentials, peers: Sequence[str] = ()
) -> dict[str, object]:
    """Return the settings of a router; credentials grant the rights of the table of services."""
    settings = settings_of("router", endpoint, credentials, peers)
    settings["transport/unicast/max_sessions"] = most_sessions(robots)
    if credentials is None:
        return settings | {"adminspace": {"enabled": False}}
    return settings | {
        "access_control": access_control(robots, linked=bool(peers)),
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
    }


def zenohd_configuration(
    endpoint: str, robots: Sequence[str], credentials: Credentials
) -> dict[str, object]:
    """Return the configuration by which Eclipse's router, ``zenohd``, behaves as ``Router``."""
    tree: dict[str, Any] = {}
    for path, value in router_settings(endpoint, robots, credentials).items():
        *folders, last = path.split("/")
        at = tree
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return tree


def runtime(threads: int) -> str:
    """Return the value of ``ZENOH_RUNTIME`` for a number of receiving threads."""
    return f"(rx: (worker_threads: {threads}), net: (worker_threads: {NET_THREADS}))"


def addresses(endpoint: str) -> list[str]:
    """Return the addresses in a comma-separated list; BusError if one is malformed."""
    found = endpoint.split(",")
    for one in found:
        host_and_port(one)
    return found


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return host and port of a router; BusError for addresses that Zenoh retries for ever."""
    match = re.fullmatch(ENDPOINT_PATTERN, endpoint)
    if match is None or int(match[2]) > 65535:
        form = f"tcp/<host>:<port> or tls/<host>:<port>, for example {DEFAULT_ROUTER}"
        shown = re.sub(r"[^/\s]+@", "***@", endpoint)  # A log must not show a password.
        raise BusError(f"invalid router address {shown[:100]!r}: expected {form}")
    return match[1].strip("[]"), int(match[2])


def check_credentials(endpoint: str, credentials: Credentials) -> None:
    """Raise BusError unless addresses are encrypted exactly if the credentials are a certificate."""
    for one in addresses(endpoint):
        if encrypted(one) and credentials is None:
            raise BusError(
                f"{one} needs a certificate; give --secure DIR, or set SMAL_TLS_CA, _CERT and _KEY"
            )
        if credentials is not None and not encrypted(one):
            raise BusError(
                f"{one} is not encrypted: with a certificate give an address that begins with tls/"
            )


def _open(settings: dict[str, object], threads: int) -> zenoh.Session:
    """Open a session; a process's first session sets the number of receiving threads."""
    keep_small()
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


def start_log(filters: str) -> None:
    """Log Zenoh's messages to standard output by filters, after those of the environment."""
    asked = os.environ.get(_LOG)
    os.environ[_LOG] = filters if asked is None else f"{asked},{filters}"
    os.environ["NO_COLOR"] = "1"
    zenoh.try_init_log_from_env()


def open_client(endpoint: str, credentials: Credentials, patience_s: float) -> zenoh.Session:
    """Connect to the first router that accepts; BusError after the timeout."""
    deadline = time.monotonic() + patience_s
    # At the start Zenoh tries only the first address; it tries the others after losing that one.
    order = addresses(endpoint)
    while True:
        for _ in order:
            with suppress(zenoh.ZError):
                return _open(settings_of("client", ",".join(order), credentials), CLIENT_THREADS)
            order = [*order[1:], order[0]]
        if time.monotonic() > deadline:
            raise BusError("; ".join(_why_no_router(one, credentials) for one in order))


def _why_no_router(endpoint: str, credentials: Credentials) -> str:
    """Distinguish a router that refuses the connection from a missing router."""
    try:
        socket.create_connection(host_and_port(endpoint), 1.0).close()
    except OSError:
        return f"no router at {endpoint}; start the stack with `smal up`"
    full = f"is full (it takes {MAX_SESSIONS} sessions, {len(LANES)} of each program)"
    if credentials is not None:
        refused = why_refused(credentials, *host_and_port(named(endpoint)))
        return refused or f"{endpoint} is not an encrypted router, does not answer, or {full}"
    return f"{endpoint} is not a router, requires a certificate, or {full}"


def connected_sockets() -> Iterator[tuple[int, str]]:
    """Yield the TCP connections of this process: file descriptor and remote address."""
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if not path.is_socket():
                continue
            with socket.socket(fileno=os.dup(int(path.name))) as one:
                if one.family in (socket.AF_INET, socket.AF_INET6):
                    host, port = one.getpeername()[:2]
                    yield (
                        int(path.name),
                        f"[{host}]:{port}" if one.family == socket.AF_INET6 else f"{host}:{port}",
                    )


def reset(fd: int) -> None:
    """Reset a TCP connection; unlike `shutdown`, this drops received unread data (connect(2))."""
    _LIBC.connect(fd, _UNSPECIFIED, len(_UNSPECIFIED))


class Router:
    """Zenoh router in this process.

    Parameters
    ----------
    endpoint
        Address to listen on.
    credentials
        Certificate. Clients then need one as well and have the rights of their role. Without it
        everyone has all rights.
    robots
        Ids of the robots.
    insecure
        Whether to listen without credentials where other machines can connect; with credentials
        it is an error.
    peers
        Addresses of other routers, whose clients share the bus.

    Raises
    ------
    BusError
        If an address is malformed, its port is taken, access is insecure, or `insecure` is given
        with credentials.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ROUTER,
        credentials: Credentials = None,
        *robots: str,
        insecure: bool = False,
        peers: Sequence[str] = (),
    ) -> None:
        host, _ = host_and_port(endpoint)
        for one in (endpoint, *peers):
            check_credentials(one, credentials)
        if insecure and credentials is not None:
            raise BusError(
                "--insecure contradicts certificates (--secure or SMAL_TLS_CERT); give one of them"
            )
        if credentials is None and not insecure and others_reach(host):
            raise BusError(
                f"{endpoint} can be reached from other machines, and anyone there could drive the "
                "robot; give --secure DIR (`smal secure init` makes it), or --insecure"
            )
        try:
            self._session = _open(
                router_settings(endpoint, robots, credentials, peers), most_sessions(robots)
            )
        except zenoh.ZError as error:
            reason = (
                "the port is in use"
                if "in use" in str(error)
                else str(error).partition(" at /")[0][:200]
            )
            raise BusError(
                f"cannot listen on {endpoint}: {reason}; stop its user, or choose another port"
            ) from None

    def disconnect(self, session: str) -> bool:
        """Reset the newest connection of a client by the prefix of its session id.

        Data that the router has not read yet are dropped. Ids are random: a client whose id has
        another client's prefix is an imitation, and is the newer one.

        Returns
        -------
        bool
            Whether there is such a connection.
        """
        remote = {
            link.dst.partition("/")[2]
            for link in self._session.info.links()
            if str(link.zid).startswith(session)
        }
        found = [(os.fstat(fd).st_ino, fd) for fd, peer in connected_sockets() if peer in remote]
        if found:
            _, newest = max(found)
            reset(newest)
        return bool(found)

    def close(self) -> None:
        """Stop routing."""
        self._session.close()
