"""Sessions of Zenoh: a router in this process, and clients of one; and all that Zenoh is told by settings.

Where routers are, what they and clients take, and how each message travels.
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
#: Others that Zenoh knows are left out: who asks for them can hold up everybody, or is not bound by a certificate.
ENDPOINT_PATTERN: Final = r"(?:tcp|tls)/([^\s/@]+):(\d{1,5})"
ATTEMPT_MS: Final = (
    800  # How long one attempt to reach a router lasts; between two attempts a signal is noticed.
)
#: What a message takes beside its payload: key, encoding and Zenoh's own fields are 300 bytes.
_OVERHEAD_BYTES: Final = 1024
LINK_BYTES: Final = LARGEST_BYTES + _OVERHEAD_BYTES
LEASE_MS: Final = (
    2000  # After so long a silence a link is dead, and so is one that has not said who it is.
)
#: After so long a silence of a router that has others beside it its clients go to one of those: with one attempt at the
#: silent one, which their next attempt may be, they are there within two seconds.
PAIR_LEASE_MS: Final = 1000
#: Sessions that a router takes: with Zenoh's thousand, each with messages that are not yet whole, it would run out of
#: memory. Every process has one a lane, those of a stack 24; as many again are counted while dead links have their
#: lease, and those that were there before an outage (`connection`). The rest is for 16 programs of people.
MAX_SESSIONS: Final = 120
#: What each further robot of a fleet brings: its own process, a recorder, a page and one program of people.
SESSIONS_A_ROBOT: Final = 4 * len(LANES)
#: Threads that take in what comes. A router has one for each session, so that whoever sends more than its receivers
#: take holds up themselves alone; a process on the bus has one more, for a robot's own router.
CLIENT_THREADS: Final = len(LANES) + 1
#: Threads on which lost connections are made again, each of which waits there for what is in its way: with Zenoh's one
#: the sessions of a process wait for each other, and what comes of the first ones is lost (1.10.2, a frozen router).
NET_THREADS: Final = 16
#: What a session may ask of one call in a second: whoever waits for an answer before they ask again is slower.
MOST_CALLS_HZ: Final = 10_000
_CALL_BYTES: Final = (
    2 * MAX_RPC_BYTES
)  # Largest call that a router passes on, for who is called to refuse it by name.
_GROUPS: Final = f"{group_key('*', '*')}/**"  # Of the questions of instances to each other; ``**`` does not match it.
_RUNTIME: Final = (
    "ZENOH_RUNTIME"  # Zenoh's own variable for how many threads it has for what, in a process.
)
_LOG: Final = "RUST_LOG"  # Zenoh's variable for what it logs.
_OPENING: Final = threading.Lock()
_LIBC: Final = ctypes.CDLL(None)
_UNSPECIFIED: Final = bytes(16)  # A socket address of the family AF_UNSPEC.


class Quality(NamedTuple):
    """How a message travels, in Zenoh's words: by which queue, whether it waits for room there, and whether at once."""

    priority: str
    congestion_control: str
    express: bool


_ORDINARY: Final = Quality("data_high", "drop", express=False)
#: Of the signs of life of `services.kit.echo`: they overtake all that waits. They are not express, so that several fit
#: into one batch and none waits for room on a link that is full.
ECHO_QUALITY: Final = Quality("real_time", "drop", express=False)


def quality(topic: Topic) -> Quality:
    """Return how the messages of a topic travel.

    What waits must not wait behind images: a slow link would then be closed for them. And nothing must wait behind what
    is replayed. An emergency stop has a queue that nothing else comes into.
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


def _door() -> list[dict[str, object]]:
    """Return how messages travel from the router on, whatever their senders want: the last rule that fits counts.

    Who could choose would send with the priority of an emergency stop, or have every receiver that is slower than they
    are sent away, for which Zenoh waits where a sender asks it to.
    """
    rules: list[tuple[list[str], list[str], dict[str, object]]] = [
        # The answers have the priority of the question, and what is replayed must keep its own.
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


def _bounds() -> list[dict[str, object]]:
    """Return how often each session may make each call in a second; the router drops the rest as it comes in.

    Each session is counted by itself: who floods a call keeps nobody else from it. Messages are not bounded so: Zenoh
    drops what comes too soon after the last one, and of two that waited on a slow link it would drop the newer one.
    """
    served = sorted({name for role in roles().values() for name in role.serves})
    keys = [*(rpc_key("*", *name.split("/", 1)) for name in served), _GROUPS]
    rules = [{"key_expr": key, "freq": MOST_CALLS_HZ} for key in keys]
    return [{"id": "calls", "messages": ["query"], "flows": ["ingress"], "rules": rules}]


def _everything(key: str) -> list[str]:
    """Return a key, and those of what its senders kept."""
    return [key, f"{key}/{KEPT_KEYS}"]


def settings_of(
    mode: str, endpoint: str, credentials: Credentials, peers: Sequence[str] = ()
) -> dict[str, object]:
    """Return what a router, or a client of one or of several, tells Zenoh, by the paths of Zenoh's own settings.

    A router links itself with its peers, and does so again for as long as it takes; where it is among them, with those
    before it alone. Of two who both do so one may take the other's new link for that of before (1.10.2, issue 2806).
    """
    peers = list(peers)
    before = peers[: peers.index(endpoint)] if endpoint in peers else peers
    several = [named(one) for one in (before if mode == "router" else addresses(endpoint))]
    settings: dict[str, object] = {
        "mode": mode,
        **({"listen/endpoints": [endpoint]} if mode == "router" else {}),
        **({"connect/endpoints": several} if several else {}),
        # Nothing is found by multicast: a robot must never be steered by a stranger's stack on the same network.
        "scouting/multicast/enabled": False,
        # A router would otherwise wait half a second for the scouting that is off.
        "scouting/delay": 0,
        "transport/link/tx/lease": PAIR_LEASE_MS if peers else LEASE_MS,
        "transport/shared_memory/enabled": False,
        # What is larger is dropped while it comes in, and not passed on: otherwise a message takes up to 1 GiB here.
        "transport/link/rx/max_message_size": LINK_BYTES,
        # Every sample tells when it was sent: the receiver's metrics want it, and so does replay.
        "timestamping/enabled": True,
        # Images, maps and features take many fragments; a busy machine may not drain them within the default 50 ms.
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
        # Nor is the default of 1 ms enough for a few commands in a row: a busy machine dropped 1 in 100 of them.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 100_000,
        # Episode events wait rather than be dropped. A client that does not read must not hold up everybody else for
        # the default of 5 s: its connection is closed, and it may connect again.
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
        settings["qos/network"] = _door()
        settings["downsampling"] = _bounds()
    else:
        # Only the first connection: after an outage it is made again for as long as it takes. Without this limit
        # `zenoh.open` blocks for ever where there is no router, deaf to signals.
        settings["connect/timeout_ms"] = ATTEMPT_MS
        settings["connect/exit_on_failure"] = False
        if len(several) > 1:
            # A frozen router takes connections, and never answers: after so long it is the next one's turn.
            settings["transport/unicast/open_timeout"] = ATTEMPT_MS
    if credentials is not None:
        for side in ("listen", "connect"):  # A router that is linked with another one does both.
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
    """Name what a client goes to: every address of this machine is one to listen on, which no certificate has."""
    return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/localhost:", endpoint)


def most_sessions(robots: Sequence[str]) -> int:
    """Return how many sessions the router of so many robots takes, and threads that it has: one for each."""
    return MAX_SESSIONS + SESSIONS_A_ROBOT * max(len(robots) - 1, 0)


def router_settings(
    endpoint: str, robots: Sequence[str], credentials: Credentials, peers: Sequence[str] = ()
) -> dict[str, object]:
    """Return what a router tells Zenoh: who comes with credentials may do what the table of services says."""
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
    """Return what makes Eclipse's own router, a program of its own, the same router as ``Router``."""
    tree: dict[str, Any] = {}
    for path, value in router_settings(endpoint, robots, credentials).items():
        *folders, last = path.split("/")
        at = tree
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return tree


def runtime(threads: int) -> str:
    """Return what Zenoh's variable ``ZENOH_RUNTIME`` says of a process in which so many threads take in what comes."""
    return f"(rx: (worker_threads: {threads}), net: (worker_threads: {NET_THREADS}))"


def addresses(endpoint: str) -> list[str]:
    """Return the addresses of one router, or of several, which commas separate; BusError for a malformed one."""
    found = endpoint.split(",")
    for one in found:
        host_and_port(one)
    return found


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return host and port of a router; BusError for a malformed address, which Zenoh would try for ever."""
    match = re.fullmatch(ENDPOINT_PATTERN, endpoint)
    if match is None or int(match[2]) > 65535:
        form = f"tcp/<host>:<port> or tls/<host>:<port>, for example {DEFAULT_ROUTER}"
        shown = re.sub(r"[^/\s]+@", "***@", endpoint)  # A log must not show a password.
        raise BusError(f"router address {shown[:100]!r}: expected {form}")
    return match[1].strip("[]"), int(match[2])


def check_credentials(endpoint: str, credentials: Credentials) -> None:
    """Check that addresses are encrypted where the credentials are a certificate, and only there; else a BusError."""
    for one in addresses(endpoint):
        if encrypted(one) and credentials is None:
            raise BusError(
                f"{one} needs a certificate: give --secure DIR, or set SMAL_TLS_CA, _CERT and _KEY"
            )
        if credentials is not None and not encrypted(one):
            raise BusError(
                f"{one} is not encrypted: with a certificate give an address that begins with tls/"
            )


def _open(settings: dict[str, object], threads: int) -> zenoh.Session:
    """Open a session; the first one of a process decides, by the environment, how many threads take in what comes."""
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
    """Have Zenoh log to the standard output by filters, and by those of a developer's environment."""
    asked = os.environ.get(_LOG)
    os.environ[_LOG] = filters if asked is None else f"{asked},{filters}"
    os.environ["NO_COLOR"] = "1"
    zenoh.try_init_log_from_env()


def open_client(endpoint: str, credentials: Credentials, patience_s: float) -> zenoh.Session:
    """Connect to the first router that lets us in; BusError where none does before the patience ends."""
    deadline = time.monotonic() + patience_s
    # At the start Zenoh goes to the first address alone, and comes to the others when it has lost that one.
    order = addresses(endpoint)
    while True:
        for _ in order:
            with suppress(zenoh.ZError):
                return _open(settings_of("client", ",".join(order), credentials), CLIENT_THREADS)
            order = [*order[1:], order[0]]
        if time.monotonic() > deadline:
            raise BusError("; ".join(_why_no_router(one, credentials) for one in order))


def _why_no_router(endpoint: str, credentials: Credentials) -> str:
    """Tell a router that refuses us, for whatever reason of its own, from none."""
    try:
        socket.create_connection(host_and_port(endpoint), 1.0).close()
    except OSError:
        return f"no router at {endpoint}; start the stack with `smal up`"
    full = f"is full (it takes {MAX_SESSIONS} sessions, {len(LANES)} of each program)"
    if credentials is not None:
        refused = why_refused(credentials, *host_and_port(named(endpoint)))
        return (
            refused
            or f"what listens at {endpoint} is no router that encrypts, does not answer, or {full}"
        )
    return f"what listens at {endpoint} is no router, or takes nobody in without a certificate, or {full}"


def connected_sockets() -> Iterator[tuple[int, str]]:
    """Yield the file descriptors of this process that are TCP connections, with the address at the other end."""
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
    """Reset a TCP connection: unlike `shutdown`, this drops what has arrived and is not read yet (connect(2))."""
    _LIBC.connect(fd, _UNSPECIFIED, len(_UNSPECIFIED))


class Router:
    """A Zenoh router in this process.

    With credentials only who has some as well gets in, and may do on the robot's bus what their role may; without them
    everybody may do everything, and it must be told to be ``insecure`` to listen where other machines reach it. With
    ``peers``, addresses of other routers, all their clients are on one bus. Raises BusError when an address is
    malformed, its port is taken, or strangers would get in.
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
        if credentials is None and not insecure and others_reach(host):
            raise BusError(
                f"{endpoint} can be reached from other machines, and whoever reaches it could drive the robot: "
                "give --secure DIR (`smal secure init` makes it), or --insecure"
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
                f"cannot listen on {endpoint}: {reason}; stop what uses it, or choose another port"
            ) from None

    def disconnect(self, session: str) -> bool:
        """Reset the newest connection of a client whose session's id begins so; return whether there is one.

        What the client has sent and the router has not read yet is dropped. An id that begins as another client's does
        is an imitation, and is the newer one: ids are random.
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
