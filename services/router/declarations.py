"""Disconnect sessions that flood the router with declarations: tokens, queryables, subscribers and keys.

A declaration takes the longer the more declarations stand: the router compares its key with all others
(``Resource::get_matches``), and meanwhile it routes no message. Zenoh 1.10.2 has no setting that bounds declarations.
Its log has an entry for each of them, with the session that made it. This process reads the router's log, counts the
entries of each session, and prints the session that exceeds its allowance; the router then resets its connection. The
count is a process of its own because a thread of the router waits for it where Zenoh holds a lock.
"""

import re
import socket
import sys
import time
from collections.abc import Callable
from typing import Final

#: The beginning of an entry is Zenoh's own. A key may hold line breaks: the sender can write all that follows.
_DECLARATION: Final = re.compile(
    rb"\S+ +DEBUG +\S+ +ThreadId\(\d+\) demux\{zid=\w+ src=\S*?(client|peer|router)/(([0-9a-f]+):\d+)\}.*"
    rb" zenoh::net::routing::dispatcher::(?:face: expr=|resource: Register resource )"
)
_OWN_LOG: Final = re.compile(rb" zenoh::net::(?:primitives::demux|routing::dispatcher::(?:face|resource)): ")
#: Declarations that a session may make at once: 200 for its process, and 100 for each robot that it serves. The largest
#: session of a stack with one robot makes 100.
BURST: Final = 200
BURST_A_ROBOT: Final = 100
RATE_HZ: Final = 50.0  # Declarations a second afterwards: a session that runs declares something now and then.
#: A session is new for this time, seconds: longer than a process takes to declare all it needs. A flooder that connects
#: again is new each time, so all new sessions share a bound as well: a whole stack may begin at once, then a process
#: every few seconds.
NEW_S: Final = 10.0
NEW_SESSIONS: Final = 16
NEW_RATE_HZ: Final = 50.0
MOST_SESSIONS: Final = 10_000  # Sessions whose declarations are counted at a time, ended ones among them.
_TAKEN_BACK: Final = b"expr.mapped=None"  # End of an entry that takes a declaration back by its number.
_ENTRY_BYTES: Final = 1 << 20  # Larger than any entry of the log.


class Bucket:
    """A token bucket: so many declarations at once, then so many a second."""

    def __init__(self, burst: float, rate_hz: float, now_s: float) -> None:
        self._burst = self._left = burst
        self._rate_hz = rate_hz
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Count a declaration; return whether it is within the bound."""
        self._left = min(self._burst, self._left + self._rate_hz * (now_s - self._at_s))
        self._at_s = now_s
        within = self._left >= 1.0
        self._left -= within
        return within


class Session:
    """The declarations of a session: a bucket of its own, and how many of them stand."""

    def __init__(self, burst: int, now_s: float) -> None:
        self._burst = burst
        self._bucket = Bucket(burst, RATE_HZ, now_s)
        self._standing = 0
        self._since_s = now_s

    def new(self, now_s: float) -> bool:
        """Return whether the session declared for the first time lately."""
        return now_s - self._since_s < NEW_S

    def take(self, now_s: float, standing: int) -> bool:
        """Count a declaration, and how many more stand by it; return whether it is within the bound."""
        self._standing = max(0, self._standing + standing)
        return self._bucket.take(now_s) and self._standing <= self._burst


class Declarations:
    """Count the declarations of every session.

    Parameters
    ----------
    robots
        Number of robots of the fleet, which one session may serve.
    linked
        Whether other routers pass on what their own sessions declare. Their declarations are not bounded here.
    disconnect
        Called with the beginning of a session's id when the session exceeds its allowance.
    """

    def __init__(self, robots: int, *, linked: bool, disconnect: Callable[[str], None]) -> None:
        self._burst = BURST + BURST_A_ROBOT * robots
        self._linked = linked
        self._disconnect = disconnect
        self._sessions: dict[bytes, Session] = {}
        self._new: Bucket | None = None  # Of all new sessions together.

    def count(self, line: bytes, now_s: float) -> None:
        """Count a line of Zenoh's log if it is about a declaration."""
        match = _DECLARATION.match(line)
        if match is None:
            return
        mode, face, session = match.groups()
        if mode == b"router" and self._linked:
            return
        if self._new is None:
            self._new = Bucket(NEW_SESSIONS * self._burst, NEW_RATE_HZ, now_s)
        one = self._sessions.get(face)
        if one is None:
            if len(self._sessions) >= MOST_SESSIONS:  # the oldest one has ended
                del self._sessions[next(iter(self._sessions))]
            one = self._sessions[face] = Session(self._burst, now_s)
        within = one.take(now_s, _standing(line))
        if within and one.new(now_s):
            within = self._new.take(now_s)
        if not within:
            del self._sessions[face]
            self._disconnect(session.decode())


def _standing(line: bytes) -> int:
    """Return how many more declarations stand after this one; a new key alone is none."""
    if b"::face: expr=" not in line:
        return 0
    return -1 if line.rstrip().endswith(_TAKEN_BACK) else 1


def count_log(log: socket.socket, declarations: Declarations) -> None:
    """Count the entries of the log that are about declarations, and pass all others on, until the router has ended."""
    buffer = bytearray(_ENTRY_BYTES)
    while size := log.recv_into(buffer):
        entry = bytes(memoryview(buffer)[:size])
        if _OWN_LOG.search(entry):
            declarations.count(entry, time.monotonic())
        else:
            sys.stderr.buffer.write(entry)
            sys.stderr.flush()


def print_session(session: str) -> None:
    """Have the router disconnect a session."""
    sys.stdout.write(f"{session}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    robots, linked = (int(argument) for argument in sys.argv[1:])
    count_log(socket.socket(fileno=0), Declarations(robots, linked=bool(linked), disconnect=print_session))
