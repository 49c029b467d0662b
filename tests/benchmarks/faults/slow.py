"""A client that listens to everything and then does not take it: its callback blocks."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from schemas.topics import LANES, ROOT
from services.kit.bus import Bus
from tests.benchmarks.faults.child import child


@contextmanager
def slow_consumer(robot: str, endpoint: str) -> Iterator[int]:
    """Run one for as long as the context lasts; give its process id."""
    # Its session is closed by nobody: it hangs in the callback.
    with child("the slow consumer", consume_slowly, robot, endpoint, patience_s=0.0) as (pid, _ready):
        yield pid


def consume_slowly(robot: str, endpoint: str, owner: Connection) -> None:
    """Block in the first callback, until killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner

    def block(*_sample: object) -> None:
        time.sleep(3600.0)

    bus = Bus(robot, endpoint)
    bus.wait_connected(10.0)
    for lane in LANES:
        bus.listen(f"{ROOT}/**", block, lane=lane)
    owner.send("ready")
    with contextlib.suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(0)  # the session cannot be closed: its thread hangs in the callback
