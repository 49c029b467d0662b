"""Disconnect sessions that flood the router with declarations.

Declarations are tokens, queryables, subscribers and keys. The cost of one grows with their number:
the router compares its key with all others (``Resource::get_matches``), and meanwhile it routes no
message. Zenoh 1.10.2 has no setting that limits declarations, but logs each of them with its
session. This process reads the router's log, counts the entries of each session, and prints the
session that exceeds its allowance; the router then resets its connection. A separate process
counts, because a thread of the router waits for it while Zenoh holds a lock.
"""

import re
import socket
import sys
import time
from collections.abc import Callable
from typing import Final, NamedTuple

#: Zenoh writes the beginning of an entry. A key can contain line breaks: the sender controls the
#: rest.
_DECLARATION: Final = re.compile(
    rb"\S+ +DEBUG +\S+ +ThreadId\(\d+\) demux\{zid=\w+ src=\S*?(client|peer|router)/(([0-9a-f]+):\d+)\}.*"
    rb" zenoh::net::routing::dispatcher::(?:face: expr=|resource: Register resource (?P<group>[^/]+/[^/]+/@group/)?)",
    re.DOTALL,
)
_OWN_LOG: Final = re.compile(
    rb" zenoh::net::(?:primitives::demux|routing::dispatcher::(?:face|resource)): "
)
#: Declarations that a session may make at once, and different keys that it may ever declare: 200
#: for its process, and 100 for each robot that it serves. The largest session of a stack with one
#: robot makes 100.
BURST: Final = 200
BURST_A_ROBOT: Final = 100
# Declarations a second afterwards: running sessions declare occasionally.
RATE_HZ: Final = 50.0
#: Group keys (`schemas.topics.group_key`) that a session may declare at once: its token, its
#: subscription, and a token of each robot. The router sends every token of a group to all of its
#: instances.
GROUP_BURST: Final = 4
GROUP_BURST_A_ROBOT: Final = 2
# Group keys a second afterwards: robots move between instances occasionally.
GROUP_RATE_HZ: Final = 1.0
# Sessions that are counted at a time, including ended sessions.
MOST_SESSIONS: Final = 10_000
# Part of an entry before the key. A query of tokens, too, is logged like a declaration.
_KEY: Final = b"::face: expr="
_ENTRY_BYTES: Final = 1 << 20  # Larger than any entry of the log.


class TokenBucket:
    """Token bucket: ``burst`` declarations at once, then ``rate_hz``."""

    def __init__(self, burst: int, rate_hz: float, now_s: float) -> None:
        self._burst = burst
        self._rate_hz = rate_hz
        self._left = float(burst)
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Count a declaration; return whether it is allowed."""
        regained = self._rate_hz * (now_s - self._at_s)
        self._at_s = now_s
        self._left = min(self._burst, self._left + regained) - 1.0
        return self._left >= 0.0


class _Allowance(NamedTuple):
    """Allowance of one session, and hashes of the keys that it has declared."""

    all_keys: TokenBucket
    group_keys: TokenBucket
    keys: set[int]


class Declarations:
    """Counts the declarations of every session.

    Parameters
    ----------
    robots
        Number of robots of the fleet, which one session can serve.
    linked
        Whether other routers pass on the declarations of their sessions, which are not limited
        here.
    disconnect
        Called with the beginning of a session's id when the session exceeds its allowance.
    """

    def __init__(self, robots: int, *, linked: bool, disconnect: Callable[[str], None]) -> None:
        self._burst = BURST + BURST_A_ROBOT * robots
        self._group_burst = GROUP_BURST + GROUP_BURST_A_ROBOT * robots
        self._linked = linked
        self._disconnect = disconnect
        self._allowances: dict[bytes, _Allowance] = {}

    def count(self, line: bytes, now_s: float) -> None:
        """Count a line of Zenoh's log if it is about a declaration."""
        match = _DECLARATION.match(line)
        if match is None:
            return
        mode, face, session, group = match.groups()
        if mode == b"router" and self._linked:
            return
        if face not in self._allowances:
            if len(self._allowances) >= MOST_SESSIONS:
                del self._allowances[next(iter(self._allowances))]
            self._allowances[face] = _Allowance(
                TokenBucket(self._burst, RATE_HZ, now_s),
                TokenBucket(self._group_burst, GROUP_RATE_HZ, now_s),
                set(),
            )
        all_keys, group_keys, keys = self._allowances[face]
        keys.add(hash(line.partition(_KEY)[2]))
        within = all_keys.take(now_s) and len(keys) <= self._burst
        if group is not None:
            within &= group_keys.take(now_s)
        if not within:
            del self._allowances[face]
            self._disconnect(session.decode())


def count_log(log: socket.socket, declarations: Declarations) -> None:
    """Count the log's declarations and pass on other entries, until the router ends."""
    buffer = bytearray(_ENTRY_BYTES)
    while size := log.recv_into(buffer):
        entry = bytes(memoryview(buffer)[:size])
        if _OWN_LOG.search(entry):
            declarations.count(entry, time.monotonic())
        else:
            sys.stderr.buffer.write(entry)
            sys.stderr.flush()


def print_session(session: str) -> None:
    """Print a session for the router to disconnect."""
    sys.stdout.write(f"{session}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    robots, linked = (int(argument) for argument in sys.argv[1:])
    count_log(
        socket.socket(fileno=0), Declarations(robots, linked=bool(linked), disconnect=print_session)
    )
