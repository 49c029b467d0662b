"""The router's side of the bound on declarations: its log goes to `declarations`, and floods end."""

import logging
import os
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Final

from services.kit.zenoh_session import start_log

#: Zenoh's log of declarations (of known and of new keys), and of the session that a line belongs to.
LOG: Final = ",".join(
    f"zenoh::net::{target}=debug"
    for target in (
        "primitives::demux",
        "routing::dispatcher::face",
        "routing::dispatcher::resource",
    )
)
_ROOM_BYTES: Final = (
    1 << 22
)  # Room for entries that wait to be counted: some thousands, a second of a flood.
_WAIT_US: Final = (
    100_000  # Longest wait for room in the log, microseconds: an entry that waits longer is lost.
)
_logger = logging.getLogger("router")


def take_log() -> socket.socket:
    """Have Zenoh log declarations to a socket in place of the standard output; call this before a session is opened.

    The socket keeps entries apart, so that no key can pass for an entry about another session. If the socket is full,
    the thread that handles the declaration waits until the log is read: a flood is not faster than its count.

    Returns
    -------
    socket.socket
        The socket to read the log from.
    """
    read, write = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM_BYTES)  # The system may grant less.
    write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, _WAIT_US))
    os.dup2(write.fileno(), 1)
    write.close()
    start_log(LOG)
    return read


def end_floods(
    log: socket.socket, robots: int, *, linked: bool, disconnect: Callable[[str], bool]
) -> None:
    """Disconnect every session that declares too much, on a thread of its own."""
    command = [sys.executable, "-m", "services.router.declarations", str(robots), str(int(linked))]

    def end_each() -> None:
        while True:
            with subprocess.Popen(  # noqa: S603
                command,
                stdin=log.fileno(),
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            ) as one:
                for line in one.stdout or ():
                    session = line.strip()
                    if disconnect(session):
                        _logger.warning("session %s: too many declarations; disconnected", session)
            _logger.error(
                "the count of declarations ended with status %s; it starts again", one.returncode
            )

    threading.Thread(target=end_each, name="floods", daemon=True).start()
