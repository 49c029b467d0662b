"""A link as bad as Wi-Fi at its edge, between two machines: real packets come late, or never.

Two network namespaces are the machines; each has a TUN device, by which its kernel gives IP packets to this process.
Each packet goes to the other machine when it is due: after those before it have passed at the link's rate, and after
the delay; so TCP and Zenoh meet what they meet on air, and no kernel needs netem. A packet is lost by chance, where
too many wait, and while the link is cut. Packets stay in order, as on Wi-Fi, and every one is counted, in and out.
Needs root, and Linux. Everything in a machine is run by a process that has begun with `enter`.
"""

import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

from tests.benchmarks.child import child

ADDRESSES: Final = ("10.77.0.1", "10.77.0.2")
#: How TCP answers losses, as every kernel can: on so short a link much as cubic, which few let us choose here.
CONGESTION: Final = "reno"
_NEWNET: Final = 0x40000000  # CLONE_NEWNET of <linux/sched.h>
_TUNSETIFF: Final = 0x400454CA
_TUN_NO_PI: Final = 0x1001  # IFF_TUN and IFF_NO_PI: IP packets as they are
_MTU: Final = 1500


class Quality(NamedTuple):
    """How a link is; one way is as the other."""

    delay_s: float = 0.05
    jitter_s: float = 0.02
    loss: float = 0.02
    bits_s: float = 10e6
    waits_s: float = (
        0.2  # Packets wait at the link for so long, at most; access points hold about as much.
    )


WIFI: Final = Quality()


class Link(NamedTuple):
    """A link that is up: its two machines, and who passes packets on."""

    machines: tuple[str, str]
    pipe: Connection

    def cut(self, *, cut: bool) -> None:
        """Cut the link, or mend it."""
        self.pipe.send(cut)
        self.pipe.recv()

    def counts(self) -> tuple[Counter[str], Counter[str]]:
        """Return what became of the packets from the first machine to the second so far, and of those back."""
        self.pipe.send("counts")
        told: tuple[Counter[str], Counter[str]] = self.pipe.recv()
        return told


@contextmanager
def link(quality: Quality = WIFI, congestion: str = CONGESTION, seed: int = 1) -> Iterator[Link]:
    """Join two new machines for as long as the context lasts; an OSError where this kernel or user may not."""
    with child("the link", _run, quality, congestion, seed) as one:
        if isinstance(one.said, OSError):
            raise one.said
        first, second = (f"/proc/{one.pid}/fd/{machine}" for machine in one.said)
        yield Link((first, second), one.pipe)


def enter(machine: str) -> None:
    """Be in a machine from now on, with all threads and processes that this one, the only thread so far, starts."""
    with Path(machine).open() as file:
        _check(ctypes.CDLL(None, use_errno=True).setns(file.fileno(), _NEWNET))


def _check(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, f"network namespaces: {os.strerror(number)}; this needs root")


def _machine(address: str, congestion: str) -> tuple[int, int]:
    """Make a machine, and go into it; return what keeps it, and its TUN device."""
    _check(ctypes.CDLL(None, use_errno=True).unshare(_NEWNET))
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", b"air", _TUN_NO_PI))
    for command in (
        f"addr add {address}/24 dev air",
        f"link set air mtu {_MTU} up",
        "link set lo up",
    ):
        subprocess.run(["ip", *command.split()], check=True)
    Path("/proc/sys/net/ipv4/tcp_congestion_control").write_text(congestion)
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY), device


@dataclass
class _Way:
    """One direction."""

    device: int  # Where packets go.
    quality: Quality
    chance: random.Random
    free_s: float = 0.0  # When the packets that wait at the link have passed it.
    last_s: float = 0.0
    air: deque[tuple[float, bytes]] = field(
        default_factory=deque
    )  # When each is due, and what is under way.
    counts: Counter[str] = field(default_factory=Counter)

    def take(self, packet: bytes, now_s: float, *, cut: bool) -> None:
        self.counts.update({"in": 1, "in_bytes": len(packet)})
        fate = "cut" if cut else "lost" if self.chance.random() < self.quality.loss else ""
        if not fate and self.free_s - now_s > self.quality.waits_s:
            fate = "overflowed"
        if fate:
            self.counts[fate] += 1
            return
        self.free_s = max(self.free_s, now_s) + 8 * len(packet) / self.quality.bits_s
        late_s = self.quality.delay_s + self.chance.uniform(-1.0, 1.0) * self.quality.jitter_s
        self.last_s = max(self.last_s, self.free_s + late_s)
        self.air.append((self.last_s, packet))

    def give(self, now_s: float) -> None:
        while self.air and self.air[0][0] <= now_s:
            due_s, packet = self.air.popleft()
            os.write(self.device, packet)
            self.counts.update(
                {"out": 1, "out_bytes": len(packet), "late_us": round(1e6 * (now_s - due_s))}
            )


def _run(quality: Quality, congestion: str, seed: int, owner: Connection) -> None:
    """Pass packets on until the owner of the pipe closes it, or dies."""
    try:
        (one, first), (other, second) = (_machine(address, congestion) for address in ADDRESSES)
    except OSError as error:
        owner.send(error)
        return
    owner.send((one, other))
    ways = {
        first: _Way(second, quality, random.Random(seed)),  # noqa: S311
        second: _Way(first, quality, random.Random(-seed)),  # noqa: S311
    }
    cut = False
    while True:
        dues_s = [way.air[0][0] for way in ways.values() if way.air]
        wait_s = max(0.0, min(dues_s) - time.monotonic()) if dues_s else None
        readable, _, _ = select.select([*ways, owner], [], [], wait_s)
        if owner in readable:
            try:
                asked = owner.recv()
            except EOFError:
                return
            cut = cut if asked == "counts" else asked
            owner.send(tuple(way.counts for way in ways.values()))
        now_s = time.monotonic()
        for device in (device for device in ways if device in readable):
            ways[device].take(os.read(device, _MTU), now_s, cut=cut)
        for way in ways.values():
            way.give(now_s)
