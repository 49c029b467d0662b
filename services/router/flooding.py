"""Router's part of the limit on declarations: pass its log to `declarations` and end floods."""

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

#: Zenoh's log of declarations (for known and new keys), and of the session of a line.
LOG: Final = ",".join(
    f"zenoh::net::{target}=debug"
    for target in (
        "primitives::demux",
        "routing::dispatcher::face",
        "routing::dispatcher::resource",
    )
)
_ROOM_BYTES: Final = 1 << 22  # Room for waiting entries: some thousands, a second of a flood.
# Maximum wait for room in the log, microseconds; after it the entry is lost.
_WAIT_US: Final = 100_000
_logger = logging.getLogger("router")


def take_log() -> socket.socket:
    """Redirect Zenoh's log of declarations to a socket; call this before opening a session.

    The socket separates entries, so that a key cannot imitate an entry about another session. If
    the socket is full, the thread that handles the declaration waits until the log is read, which
    limits a flood to the speed of its count.

    Returns
    -------
    socket.socket
        The socket to read the log from.
    """
    read, write = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM_BYTES)  # The system can grant less.
    write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, _WAIT_US))
    os.dup2(write.fileno(), 1)
    write.close()
    start_log(LOG)
    return read


def end_floods(
    log: socket.socket, robots: int, *, linked: bool, disconnect: Callable[[str], bool]
) -> None:
    """Disconnect every session with too many declarations, on a separate thread."""
    command = [sys.executable, "-m", "services.router.declarations", str(robots), str(int(linked))]

    def end_each() -> None:
        while True:
            with subprocess.Popen(  # noqa: S603
                command,
                stdin=log.fileno(),
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,
            ) as process:
                for line in process.stdout or ():
                    session = line.strip()
                    if disconnect(session):
                        _logger.warning("session %s: too many declarations; disconnected", session)
            _logger.error(
                "the count of declarations ended with status %s; restarting it", process.returncode
            )

    threading.Thread(target=end_each, name="floods", daemon=True).start()
