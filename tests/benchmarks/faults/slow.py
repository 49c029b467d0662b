"""A client that listens to everything and then does not take it: its callback blocks."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from schemas.topics import ROOT
from services.bus import Bus
from services.commands.errors import JobError

_STARTING_S = 30.0


@contextmanager
def slow_consumer(robot: str, endpoint: str) -> Iterator[int]:
    """Run one for as long as the context lasts; give its process id."""
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=consume_slowly, args=(robot, endpoint, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(_STARTING_S):
            raise JobError("the slow consumer did not start")
        ours.recv_bytes()
        assert process.pid is not None
        yield process.pid
    finally:
        # Its session is closed by nobody: it hangs in the callback.
        process.kill()
        process.join()


def consume_slowly(robot: str, endpoint: str, owner: Connection) -> None:
    """Block in the first callback, until killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner

    def block(*_sample: object) -> None:
        time.sleep(3600.0)

    bus = Bus(robot, endpoint)
    bus.wait_connected(10.0)
    for urgent in (False, True):
        bus.listen(f"{ROOT}/**", block, urgent=urgent)
    owner.send_bytes(b"ready")
    with contextlib.suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(0)  # the session cannot be closed: its thread hangs in the callback
