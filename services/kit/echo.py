"""Echoes of a process to itself through the router, which prove that its lanes carry both ways.

Zenoh reports a lane as connected for as long as its link is open. A receive thread that has failed
leaves the link open and receives nothing. So each lane sends the time, by this process's clock, to
every other lane: messages of one session reach another session only through the router. A lane
works when any other lane has recently received from it, and it has recently received from any other
lane.
"""

import secrets
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from itertools import permutations
from typing import Any, Final

import zenoh

from schemas.topics import LANES, Lane, echo_key
from services.kit.connection import Connection, Declared
from services.kit.history import in_order
from services.kit.zenoh_session import ECHO_QUALITY, LEASE_MS, zenoh_quality

# Time between two echoes from one lane to another, by default.
PERIOD_S: Final = 0.5
#: Age of a lane's last echo at which the process is unhealthy, seconds: as old as a silent link that
#: Zenoh closes.
SILENT_S: Final = LEASE_MS / 1000.0
#: How long a lane stays silent, from `SILENT_S` on, before its process must end, seconds. When a
#: router returns, Zenoh reaches it again by every lane within 2 s. On a machine with five times too
#: much load it took up to 6.1 s.
DEAF_S: Final = 10.0
_BYTES: Final = 8  # Size of an echo: nanoseconds of the monotonic clock.
Way = tuple[Lane, Lane]  # The lane that sends and the lane that receives.
_WAYS: Final[tuple[Way, ...]] = tuple(permutations(LANES, 2))


class LaneEcho:
    """Thread that measures the age of each lane's last echo, until it is closed.

    Parameters
    ----------
    role
        Role of the process; the router lets no other role publish on these keys or subscribe to
        them.
    connections
        The sessions of the process, by lane.
    """

    def __init__(self, role: str, connections: Mapping[Lane, Connection]) -> None:
        self._period_s = PERIOD_S
        self._connections = connections
        begun_s = time.monotonic()  # A session that has just opened counts as proved.
        #: Time at which the newest received echo was sent.
        self._sent_s = dict.fromkeys(_WAYS, begun_s)
        self._vain_s = dict.fromkeys(LANES, 0.0)
        self._declared: list[tuple[Connection, Declared[Any]]] = []
        process = secrets.token_hex(16)
        keys = {way: echo_key(role, process, *way) for way in _WAYS}
        for way, key in keys.items():
            self._subscribe(way, key)
        self._publishers = [self._publish(way, key) for way, key in keys.items()]
        self._ended = False
        self._news = threading.Event()
        self._thread = threading.Thread(target=self._run, name="echo", daemon=True)
        self._thread.start()

    def every(self, period_s: float) -> None:
        """Set the period of the echoes, seconds."""
        self._period_s = period_s
        self._news.set()

    def age_s(self, lane: Lane) -> float:
        """Return the age of the newest echo that proves that a lane carries both ways, seconds."""
        sent_s = max(self._sent_s[way] for way in _WAYS if way[0] == lane)
        received_s = max(self._sent_s[way] for way in _WAYS if way[1] == lane)
        return time.monotonic() - min(sent_s, received_s)

    def silent(self) -> tuple[Lane, ...]:
        """Return the lanes without a router, or without an echo for `SILENT_S`."""
        return tuple(
            lane for lane in LANES if self.age_s(lane) > SILENT_S or not self._has_router(lane)
        )

    def deaf(self) -> tuple[Lane, ...]:
        """Return the lanes that stay silent for `DEAF_S` more while a router is connected."""
        return tuple(lane for lane in LANES if self._vain_s[lane] > DEAF_S)

    def close(self) -> None:
        """Stop, and withdraw the declarations."""
        self._ended = True
        self._news.set()
        self._thread.join()
        for connection, declared in self._declared:
            connection.let_go(declared)

    def _has_router(self, lane: Lane) -> bool:
        return bool(self._connections[lane].session.info.routers_zid())

    def _publish(self, way: Way, key: str) -> Declared[zenoh.Publisher]:
        connection = self._connections[way[0]]
        how = zenoh_quality(ECHO_QUALITY)
        declared = connection.declare(
            lambda session: session.declare_publisher(key, **how), sends=True
        )
        self._declared.append((connection, declared))
        return declared

    def _subscribe(self, way: Way, key: str) -> None:
        def take(sample: zenoh.Sample) -> None:
            payload = sample.payload.to_bytes()
            if len(payload) != _BYTES:
                return
            sent_s = int.from_bytes(payload, "big") / 1e9
            if self._sent_s[way] < sent_s <= time.monotonic():
                self._sent_s[way] = sent_s

        connection = self._connections[way[1]]
        declared = connection.declare(
            lambda session: session.declare_subscriber(key, in_order(take))
        )
        self._declared.append((connection, declared))

    def _run(self) -> None:
        while not self._ended:
            for publisher in self._publishers:
                with suppress(zenoh.ZError):  # The session has just been replaced.
                    publisher.entity.put(time.monotonic_ns().to_bytes(_BYTES, "big"))
            self._count()
            self._news.wait(self._period_s)
            self._news.clear()

    def _count(self) -> None:
        """Add up how long lanes lack an echo despite a router; a frozen process adds nothing."""
        silent = [lane for lane in LANES if self.age_s(lane) > SILENT_S]
        there = len(silent) < len(LANES) or any(map(self._has_router, LANES))
        for lane in LANES:
            self._vain_s[lane] = (
                self._vain_s[lane] + self._period_s if there and lane in silent else 0.0
            )
