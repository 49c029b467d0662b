"""The bad link does what it says: to real packets, between two machines, and it counts them."""

import os
import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from tests.benchmarks.child import child
from tests.benchmarks.link import ADDRESSES, Link, Quality, enter, link
from tests.services.waiting import eventually

pytestmark = pytest.mark.system

BAD = Quality(loss=0.1)
PACKETS = 200  # Fewer than a device, and a socket, keep for who is slow to take them.


@pytest.fixture(scope="module")
def air() -> Iterator[Link]:
    """Give a link; only who is not root, or whose machine has no TUN, may go without this test."""
    if os.geteuid() or not Path("/dev/net/tun").exists():
        pytest.skip("network namespaces and TUN devices need root, and /dev/net/tun")
    with link(BAD) as one:
        yield one


def send(machine: str, owner: Connection) -> None:
    enter(machine)
    owner.send("ready")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out, suppress(EOFError):
        while True:
            for number in range(*owner.recv()):
                out.sendto(struct.pack("qd", number, time.monotonic()), (ADDRESSES[1], 5000))
            owner.send("sent")


def hear(machine: str, owner: Connection) -> None:
    enter(machine)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind((ADDRESSES[1], 5000))
        owner.send("ready")
        while owner not in select.select([heard, owner], [], [])[0]:
            number, sent_s = struct.unpack("qd", heard.recv(100))
            owner.send((number, time.monotonic() - sent_s))


def test_real_packets_come_late_in_order_or_never_and_all_are_counted(air: Link) -> None:
    with ExitStack() as stacked:
        heard = stacked.enter_context(child("who hears", hear, air.machines[1])).pipe
        sender = stacked.enter_context(child("who sends", send, air.machines[0])).pipe

        def sent(*numbers: int) -> None:
            sender.send(numbers)
            sender.recv()

        def settled() -> bool:
            there, _ = air.counts()
            return (
                there["in"] >= PACKETS
                and there["in"] == there["out"] + there["lost"] + there["cut"]
            )

        sent(PACKETS)
        eventually(settled)
        there, back = air.counts()
        assert 0.02 < there["lost"] / there["in"] < 0.2
        assert there["out_bytes"] > 0.8 * there["in_bytes"] > 0
        assert back["in"] < PACKETS / 4, "each way has packets of its own"
        came = [heard.recv()]
        while heard.poll(1.0):
            came.append(heard.recv())
        numbers, ages_s = zip(*came, strict=True)
        assert PACKETS - there["lost"] <= len(came) < PACKETS
        assert list(numbers) == sorted(numbers)
        assert min(ages_s) >= BAD.delay_s - BAD.jitter_s

        air.cut(cut=True)
        sent(PACKETS, PACKETS + 20)
        eventually(lambda: air.counts()[0]["cut"] >= 20)
        air.cut(cut=False)
        sent(PACKETS + 20, PACKETS + 60)
        assert heard.recv()[0] >= PACKETS + 20, "what was sent while it was cut never comes"
