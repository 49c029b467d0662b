"""Disconnect sessions that flood the router with declarations: tokens, queryables, subscribers and keys.

A declaration takes the longer the more declarations stand: the router compares its key with all others
(``Resource::get_matches``), and meanwhile it routes no message. Zenoh 1.10.2 has no setting that bounds declarations.
Its log has a line for each of them, with the session that made it. So the router reads its own log, counts the lines
of each session, and resets the connection of a session that exceeds its allowance.
"""

import logging
import os
import re
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Final

import zenoh

_logger = logging.getLogger("router")
#: Zenoh's log of declarations (of known and of new keys), and of the session that a line belongs to.
LOG: Final = ",".join(
    f"zenoh::net::{target}=debug"
    for target in ("primitives::demux", "routing::dispatcher::face", "routing::dispatcher::resource")
)
#: Only the beginning of an entry is Zenoh's own. A key may hold line breaks, and what follows was written by the sender.
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
_ENTRY_BYTES: Final = 1 << 20  # Larger than any entry of the log.
_WAIT_US: Final = 100_000  # Longest wait for room in the log, microseconds: an entry that waits longer is lost.
_LOG_VARIABLE: Final = "RUST_LOG"  # Read by Zenoh; a developer may set it as well.


class Allowance:
    """A token bucket: ``burst`` declarations at once, then `RATE_HZ`."""

    def __init__(self, burst: int, now_s: float) -> None:
        self._burst = burst
        self._left = float(burst)
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Count a declaration; return whether it is within the allowance."""
        regained = RATE_HZ * (now_s - self._at_s)
        self._at_s = now_s
        self._left = min(self._burst, self._left + regained) - 1.0
        return self._left >= 0.0

    def full(self, now_s: float) -> bool:
        """Whether the session has declared nothing for so long that its allowance is the initial one."""
        return self._left + RATE_HZ * (now_s - self._at_s) >= self._burst


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
        self._allowances: dict[bytes, Allowance] = {}

    def count(self, line: bytes, now_s: float) -> None:
        """Count a line of Zenoh's log if it is about a declaration."""
        match = _DECLARATION.search(line)
        if match is None:
            return
        mode, face, session = match.groups()
        if mode == b"router" and self._linked:
            return
        allowance = self._allowances.get(face)
        if allowance is None:
            self._allowances = {one: left for one, left in self._allowances.items() if not left.full(now_s)}
            allowance = self._allowances[face] = Allowance(self._burst, now_s)
        if not allowance.take(now_s):
            del self._allowances[face]
            self._disconnect(session.decode())


def read_log(log: socket.socket, out: int, count: Callable[[bytes, float], None]) -> None:
    """Count the entries of Zenoh's log that are about declarations, and write all others out; ends with the process."""
    while entry := log.recv(_ENTRY_BYTES):
        if _OWN_LOG.search(entry):
            count(entry, time.monotonic())
        else:
            os.write(out, entry)


def take_log() -> tuple[socket.socket, int]:
    """Have Zenoh log declarations to a socket in place of the standard output; call this before a session is opened.

    The socket keeps entries apart, so that no key can pass for an entry about another session. If the socket is full,
    the thread that handles the declaration waits until the log is read: a flood is not faster than its count.

    Returns
    -------
    tuple[socket.socket, int]
        The socket to read from, and the standard output of before.
    """
    read, write = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, _WAIT_US))
    out = os.dup(1)
    os.dup2(write.fileno(), 1)
    write.close()
    asked = os.environ.get(_LOG_VARIABLE)
    os.environ[_LOG_VARIABLE] = LOG if asked is None else f"{asked},{LOG}"
    os.environ["NO_COLOR"] = "1"
    zenoh.try_init_log_from_env()
    return read, out


def bound_declarations(
    log: tuple[socket.socket, int], robots: int, *, linked: bool, disconnect: Callable[[str], bool]
) -> None:
    """Disconnect every session that exceeds its allowance, on a thread of its own."""

    def end(session: str) -> None:
        if disconnect(session):
            _logger.warning("session %s: too many declarations; disconnected", session)

    def end_aside(session: str) -> None:
        # The log must be read on: Zenoh may hold a lock that `disconnect` needs while it waits for room in the log.
        threading.Thread(target=end, args=(session,), name=f"end of session {session}", daemon=True).start()

    declarations = Declarations(robots, linked=linked, disconnect=end_aside)
    threading.Thread(target=read_log, args=(*log, declarations.count), name="declarations", daemon=True).start()
