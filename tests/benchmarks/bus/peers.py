"""The other processes of the benchmark of the bus: who receives, and who floods."""

import contextlib
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import zenoh

from schemas.topics import Topic
from services.kit.credentials import credentials_in
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from tests.services.secured import ROBOT, open_session

RATE_HZ: Final = 10_000  # Rate of the flood of one process.
_SIZE: Final = 200  # As long as a command is.


def plain_beside(topic: Topic) -> Topic:
    """Return the same topic under another key, for bytes that are no message of ours."""
    return replace(topic, name=f"plain/{topic.name}")


def receive(
    endpoint: str, keys: Path | None, topics: Sequence[Topic], arrivals: Connection
) -> None:
    """Tell when each message has arrived, monotonic nanoseconds, until the other process closes its end."""
    kept = []

    def arrived(*_message: object) -> None:
        arrivals.send(time.monotonic_ns())

    def take_plain(sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        arrived()

    def end() -> None:
        with contextlib.suppress(EOFError, OSError):
            arrivals.recv()
        node.stop()

    with Node("receiver", ServiceSettings(robot=ROBOT, router=endpoint, secure=keys)) as node:
        for topic in topics:
            node.subscribe(topic, arrived)
            if keys is None:  # with certificates nothing but topics gets through
                handler = zenoh.handlers.Callback(take_plain, indirect=False)
                key = plain_beside(topic).key(ROBOT)
                kept.append(node.bus.sessions[topic.lane].declare_subscriber(key, handler))
        threading.Thread(target=end, daemon=True).start()
        arrivals.send("ready")
        node.spin()


def flood(endpoint: str, keys: Path, key: str, owner: Connection) -> None:
    """Publish with a watcher's certificate what it may not, until the owner is gone; tell the rate once a second."""
    session = open_session(endpoint, credentials_in(keys, "watcher"))
    sent = 0
    began_s = time.monotonic()
    told_s = time.monotonic()
    while not owner.poll():
        session.put(
            key, bytes(_SIZE), priority=zenoh.Priority.REAL_TIME, express=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )  # fmt: skip
        sent += 1
        now_s = time.monotonic()
        if now_s - told_s >= 1.0:
            owner.send(sent / (now_s - began_s))
            told_s = now_s
        time.sleep(max(0.0, began_s + sent / RATE_HZ - now_s - 1e-3))
