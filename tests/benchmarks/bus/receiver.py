"""The receiving process of the benchmark of the bus: it says when each message has arrived, and its processor time."""

from __future__ import annotations

import contextlib
import struct
import sys
import threading
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Final

import zenoh

from schemas.codec import decode
from schemas.topics import Topic
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.kit.zenoh_wire import ZenohWire
from tests.benchmarks.bus.messages import CASES

#: Robots, so that the ways to receive stay apart: in the callback of a ``Bus``, or as a service does, by a ``Node``.
CALLBACK: Final = "bench-callback"
NODE: Final = "bench-node"
#: Ways to send bytes alone: with an ordinary publisher, and with the one that the bus declares for the topic.
BYTES_ALONE: Final = ("plain", "same publisher")
#: Arrival on the monotonic clock, which processes share, and the processor time of this process; nanoseconds.
ARRIVAL: Final = struct.Struct("<qq")


def beside(topic: Topic, way: str) -> Topic:
    """Return the same topic under another key, for bytes that are no message of ours."""
    return replace(topic, name=f"{way.replace(' ', '-')}/{topic.name}")


def session_of(bus: Bus, topic: Topic) -> zenoh.Session:
    """Return the session that a bus uses for a topic: plain Zenoh is measured on the very same one."""
    assert isinstance(bus._wire, ZenohWire)
    return bus._wire.sessions[topic.lane]


def main() -> None:
    """Run the process, which has inherited its end of the pipe."""
    *_, endpoint, pipe = sys.argv
    receive(endpoint, Connection(int(pipe)))


def receive(endpoint: str, arrivals: Connection) -> None:
    """Receive what the cases send until the other process closes its end."""
    settings = ServiceSettings(robot=NODE, router=endpoint)
    # With certificates only that robot's topics get through: neither bytes alone nor another robot's.
    bus = Bus(CALLBACK, endpoint) if settings.secure is None else None
    with Node("receiver", settings) as node:
        for case in CASES:
            _subscribe(case.topic, bus, node, arrivals)
        threading.Thread(target=_stop_when_closed, args=(node, arrivals), daemon=True).start()
        arrivals.send_bytes(b"ready")
        node.spin()
    if bus is not None:
        bus.close()


def _subscribe(topic: Topic, bus: Bus | None, node: Node, arrivals: Connection) -> None:
    """Receive a topic in every way; each ends with the time at which the message, or its bytes, can be used."""

    def arrived(*_message: object) -> None:
        arrivals.send_bytes(ARRIVAL.pack(time.monotonic_ns(), time.process_time_ns()))

    def take_plain(sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        arrived()

    def take(payload: bytes, encoding: str, *_facts: object) -> None:
        decode(topic.message, payload, encoding)
        arrived()

    node.subscribe(topic, arrived)
    if bus is None:
        return
    for way in BYTES_ALONE:
        handler = zenoh.handlers.Callback(take_plain, indirect=False)
        key = beside(topic, way).key(CALLBACK)
        _KEPT.append(session_of(bus, topic).declare_subscriber(key, handler))
    bus.subscribe(topic, take)


#: A subscriber ends when nobody knows it any more.
_KEPT: Final[list[object]] = []


def _stop_when_closed(node: Node, arrivals: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        arrivals.recv_bytes()
    node.stop()
