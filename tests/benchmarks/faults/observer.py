"""The observer: a process of its own that notes every message of a robot, and nothing else.

It asks for what it missed in an outage, as the recorder does; such messages are noted with the time of their late
arrival, so whoever judges by the log goes by the stamps of the messages.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Final

from schemas.codec import DecodeError, decode
from schemas.topics import TOPICS, Topic
from services.kit.bus import Bus
from tests.benchmarks.faults.child import child
from tests.benchmarks.faults.log import entry_of

_CONNECTING_S: Final = 30.0
_STOPPING_S: Final = 5.0
_Arrived = tuple[Topic, bytes, str, float]


@contextmanager
def observing(robot: str, endpoint: str, log: Path) -> Iterator[int]:
    """Have everything noted in a new log for as long as the context lasts; give the observer's process id."""
    log.touch()
    with child("the observer", observe, robot, endpoint, log, patience_s=_STOPPING_S) as (pid, _ready):
        yield pid


def observe(robot: str, endpoint: str, log: Path, owner: Connection) -> None:
    """Note every message until the owner of the pipe closes it, or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner
    arrived: SimpleQueue[_Arrived | None] = SimpleQueue()
    writer = Thread(target=_write, args=(log, arrived))
    writer.start()
    try:
        with closing(Bus(robot, endpoint)) as bus:
            for topic in TOPICS.values():
                _listen(bus, topic, arrived)
            bus.wait_connected(_CONNECTING_S)
            owner.send("ready")
            with contextlib.suppress(EOFError, OSError):
                owner.recv_bytes()
    finally:
        arrived.put(None)
        writer.join()


def _listen(bus: Bus, topic: Topic, arrived: SimpleQueue[_Arrived | None]) -> None:
    def take(payload: bytes, encoding: str, *_transit: object) -> None:
        arrived.put((topic, payload, encoding, time.monotonic()))

    bus.subscribe(topic, take, lambda why: sys.stderr.write(f"observer: {why}\n"), replay=topic.recorded)


def _write(log: Path, arrived: SimpleQueue[_Arrived | None]) -> None:
    """Write a line for each message, whole and at once."""
    with log.open("a", buffering=1) as file:
        while (one := arrived.get()) is not None:
            topic, payload, encoding, t_s = one
            try:
                file.write(entry_of(decode(topic.message, payload, encoding), t_s).line())
            except DecodeError as error:
                sys.stderr.write(f"observer: {error}\n")
