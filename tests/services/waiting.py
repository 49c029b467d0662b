"""Waiting for events, never for a fixed time."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TypeVar
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
import zenoh

from schemas.base import Message
from schemas.codec import decode, encoding_of
from schemas.rpc import Nothing, Status
from schemas.topics import Topic
from services.kit.bus import Bus, RpcError

T = TypeVar("T")
#: Deadline of what starts processes, seconds; ten times what that takes with 20 busy processes on two cores.
DEADLINE_S: Final = 500.0
Lost = Callable[[float], float]  # See `stalls`.


def eventually(get: Callable[[], T], timeout_s: float = 100.0) -> T:
    """Call ``get`` until it returns something true; fail after ``timeout_s``."""
    deadline = time.monotonic() + timeout_s
    while not (value := get()):
        if time.monotonic() > deadline:
            pytest.fail(f"nothing true within {timeout_s} s from {get}")
        time.sleep(0.005)
    return value


@contextmanager
def stalls() -> Iterator[Lost]:
    """Give for how long, in all since a time, this machine held up a thread that had nothing to do but to wake.

    What is promised within a time is late by that here, and nobody's fault: on a quiet machine, some milliseconds.
    """
    times = [time.monotonic()]
    ended = threading.Event()

    def wake() -> None:
        while not ended.wait(0.005):
            times.append(time.monotonic())

    def lost_s(since_s: float) -> float:
        woken = [one for one in times if one >= since_s]
        return time.monotonic() - since_s - 0.005 * len(woken)

    thread = threading.Thread(target=wake, daemon=True)
    thread.start()
    yield lost_s
    ended.set()
    thread.join()


def status_of(client: Bus, service: str) -> Status | None:
    """Return a service's status, or None while it does not answer."""
    try:
        return client.call(service, "status", Nothing(), Status, timeout_s=5.0, patience_s=0.0)
    except RpcError:
        return None


def ready(client: Bus, service: str) -> Status:
    """Wait until a service is ready."""

    def get() -> Status | None:
        status = status_of(client, service)
        return status if status is not None and status.state == "ready" else None

    return eventually(get)


def introduce(client: Bus, service: str, *messages: Message) -> None:
    """Send messages until the service has received one on each of their topics: from then on none is lost."""
    waiting = {message.topic_name: message for message in messages}

    def all_received() -> bool:
        status = status_of(client, service)
        for topic in [name for name in waiting if status is not None and status.received.get(name)]:
            del waiting[topic]
        for message in waiting.values():
            client.publish(message)
        return not waiting

    eventually(all_received)


def send_as_stranger(bus: Bus, topic: Topic, payload: bytes, encoding: str = "zenoh/bytes") -> None:
    """Send bytes that the schema of the topic does not know, and keep none of them."""
    key = topic.key(bus.robot)
    # One who does not let Zenoh drop anything of it.
    wait = zenoh.CongestionControl.BLOCK
    bus.sessions[topic.lane].put(key, payload, encoding=encoding, congestion_control=wait)


def malformed(client: Bus, service: str, topic: Topic) -> None:
    """Send rubbish on a topic, and see it counted by a service that goes on."""
    for count, payload in enumerate((b"", b"\xc1", b"\x81\xa1x" * 1000), start=1):
        send_as_stranger(client, topic, payload, encoding_of(topic.message))

        def counted(count: int = count) -> bool:
            status = status_of(client, service)
            return status is not None and status.bad.get(topic.name, 0) == count

        eventually(counted)


def health(address: str) -> str:
    """Return the health that a service reports, empty while it does not listen."""
    try:
        with urlopen(f"http://{address}/healthz") as answer:
            return str(answer.read().decode())
    except HTTPError as error:
        return str(error.read().decode())
    except OSError:
        return ""


def collected(bus: Bus, topic: Topic) -> list[Any]:
    """Subscribe to a topic; return the list to which its messages are appended."""
    messages: list[Any] = []

    def take(payload: bytes, encoding: str, _transit_s: float | None) -> None:
        messages.append(decode(topic.message, payload, encoding))

    bus.subscribe(topic, take)
    return messages
