"""Link: a robot on one machine, perception on another, and between them a link as bad as Wi-Fi at its edge.

Each machine has a router of its own, which knows the other's. On the robot's are the gate with a base that moves by its
own clock, the camera (320x240) and, in the row "features", the features; recognition, policy and recorder are on the
other, and so are features otherwise. A row is one run by `smal run --realtime` from the other machine: whether it was
found; pictures and obeyed commands a second; the age of those, from the capture of their frame; bytes a second to the
perception and back; and what part of the packets was lost. Where the link is cut for 5 s: how long after the cut the
base stood, and how long after its end it moved again. "own" is what a robot's own processes take (ROS 2, features,
router) at 10 frames a second, together without what they share counted twice; the fake base and its camera are not
among them.
"""

import ctypes
import fcntl
import json
import math
import os
import random
import re
import select
import struct
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.rpc import Nothing, Status
from schemas.topics import APPLIED, COMMANDS, EPISODE, JPEG
from services.cli import options
from services.cli.stack import Stack, StackPlan, flags
from services.kit.bus import Bus
from services.kit.errors import JobError
from tests.benchmarks.child import Child, child
from tests.benchmarks.drives import taught
from tests.benchmarks.faults.judge import Entry, Window, obeyed, stood_s
from tests.benchmarks.faults.rig import ROBOT, WORLD, note
from tests.benchmarks.faults.wheels import read_steps, rolling
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table, used
from tests.command import run_smal
from tests.ros2.field import Robot, day_with

ADDRESSES: Final = ("10.77.0.1", "10.77.0.2")
#: How TCP answers losses, as every kernel can: on so short a link much as cubic, which few let us choose here.
CONGESTION: Final = "reno"
_NEWNET: Final = 0x40000000  # CLONE_NEWNET of <linux/sched.h>
_TUNSETIFF: Final = 0x400454CA
_TUN_NO_PI: Final = 0x1001  # IFF_TUN and IFF_NO_PI: IP packets as they are
_MTU: Final = 1500
_LOOK_S: Final = 60.0  # Longest wait for a packet: select takes no infinity.


class Quality(NamedTuple):
    """How a link is; one way is as the other."""

    delay_s: float = 0.05
    jitter_s: float = 0.02
    loss: float = 0.02
    bits_s: float = 10e6
    # Packets wait at the link for so long, at most; access points hold about as much.
    waits_s: float = 0.2


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

    @property
    def due_s(self) -> float:
        """When the next packet is due; infinity if none is under way."""
        return self.air[0][0] if self.air else math.inf

    def give(self, now_s: float) -> None:
        while self.due_s <= now_s:
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
    with suppress(EOFError):
        _pass_on(ways, owner)


def _pass_on(ways: dict[int, _Way], owner: Connection) -> None:
    """Pass packets on by device, and obey the owner; EOFError when it is gone."""
    cut = False
    while True:
        due_s = min(way.due_s for way in ways.values())
        wait_s = min(max(0.0, due_s - time.monotonic()), _LOOK_S)
        readable, _, _ = select.select([*ways, owner], [], [], wait_s)
        if owner in readable:
            asked = owner.recv()
            cut = cut if asked == "counts" else asked
            owner.send(tuple(way.counts for way in ways.values()))
        now_s = time.monotonic()
        for device in ways.keys() & set(readable):
            ways[device].take(os.read(device, _MTU), now_s, cut=cut)
        for way in ways.values():
            way.give(now_s)


CAMERA: Final = (320, 240)
CUT_S: Final = 5.0
OWN_FRAMES: Final = 300
_HELD: Final = ("Rss", "Private_Dirty")  # Fields of a mapping in Linux's `smaps`.
_CUT_AFTER_S: Final = 8.0  # Time of driving before the cut.
_ROUTERS: Final = tuple(f"tcp/{address}:7447" for address in ADDRESSES)


@dataclass(frozen=True)
class Row:
    """One run."""

    name: str
    quality: Quality = WIFI
    congestion: str = "reno"
    features: int = 1  # On which machine the features are made.
    radio: bool = True  # Whether the robot is told that it is one.
    cut: bool = False


ROWS: Final = tuple(
    Row(name, **how)
    for name, how in {
        "a good link": {"quality": Quality(0.001, 0.0, 0.0, 1e9), "radio": False},
        "not told": {"radio": False},
        "radio": {},
        "radio, bbr": {"congestion": "bbr"},
        "radio, bbr, features": {"congestion": "bbr", "features": 0},
        "radio, cut": {"cut": True},
        "radio, bbr, cut": {"congestion": "bbr", "cut": True},
    }.items()
)


QUICK: Final = ("radio, bbr, cut",)


def machine(where: str, at: int, row: Row, model: Path, folder: Path, owner: Connection) -> None:
    """Be one of the two machines: run its stack until the owner of the pipe closes it, and do what is asked."""
    enter(where)
    width, height = CAMERA
    with ExitStack() as stacked:
        wheels = stacked.enter_context(rolling(WORLD, folder / "steps.jsonl")) if at == 0 else None
        own = {
            "router": flags(insecure=True, peers=_ROUTERS[1 - at]),
            "robot": flags(
                world=WORLD,
                camera_width=width,
                camera_height=height,
                wheels=wheels,
                radio=row.radio,
            ),
            **dict.fromkeys(("recognition", "policy"), flags(model=model, root=model.parent)),
            "recorder": flags(recordings=folder / "recordings"),
        }
        here = [("robot",), ("recognition", "policy", "recorder")][at]
        services = ("router", *here, *(("features",) if at == row.features else ()))
        modules = {"robot": "tests.benchmarks.faults.robot"}
        plan = StackPlan(
            services, ROBOT, _ROUTERS[at], own, logs=folder / f"logs{at}", modules=modules
        )
        stacked.enter_context(Stack(plan))
        arrived: list[Entry] = []
        if at == 0:
            bus = stacked.enter_context(closing(Bus(ROBOT, _ROUTERS[at])))
            for topic in (APPLIED, EPISODE, JPEG, COMMANDS["policy"]):
                note(bus, topic, arrived)
        owner.send("ready")
        while True:
            try:
                asked = owner.recv()
            except EOFError:
                return
            if asked == "arrived":
                owner.send(list(arrived))
            else:
                done = run_smal(*asked)
                owner.send(done.stderr.strip().splitlines()[-1] if done.returncode else "")


def run(row: Row, model: Path, folder: Path) -> Record:
    """Have the robot search once; return what the table holds."""
    folder.mkdir(parents=True)
    with link(row.quality, row.congestion) as air, ExitStack() as stacked:
        robot, other = (
            stacked.enter_context(child(f"machine {at}", machine, where, at, row, model, folder))
            for at, where in enumerate(air.machines)
        )
        out = folder / "run.json"
        before = air.counts()
        began_s = time.monotonic()
        other.pipe.send(["run", "--model", model, "--world", WORLD, "--episodes", 1, "--seed", 1, "--json", out,
                         "--connect", _ROUTERS[1], "--robot", ROBOT, "--realtime"])  # fmt: skip
        fault = _cut(air, robot, other) if row.cut else None
        if said := other.pipe.recv():
            raise JobError(f"{row.name}: {said}; see {folder}")
        seconds = time.monotonic() - began_s
        after = air.counts()
        entries = _arrived(robot)
    episode = json.loads(out.read_text())["episodes"][0]
    frames = obeyed(entries)
    ages_ms = [1e3 * (one.accepted_s - one.captured_s) for one in frames]
    driving_s = max(one.t_s for one in entries) - min(one.t_s for one in entries)
    passed = [
        {name: count - earlier[name] for name, count in later.items()}
        for later, earlier in zip(after, before, strict=True)
    ]
    told = {
        "run": row.name,
        "outcome": episode["outcome"],
        "s": driving_s,
        "frames_hz": sum(one.topic == JPEG.name for one in entries) / driving_s,
        "obeyed_hz": len(frames) / driving_s,
        **{
            f"p{share}_ms": float(np.percentile(ages_ms, share)) if ages_ms else None
            for share in (50, 95)
        },
        "sent_kb_s": passed[0]["out_bytes"] / seconds / 1e3,
        "back_kb_s": passed[1]["out_bytes"] / seconds / 1e3,
        "packets": passed[0]["in"],
        "lost": 1 - passed[0]["out"] / passed[0]["in"],
    }
    stood, again = (
        stood_s(read_steps(folder / "steps.jsonl", 0.0), fault)
        if fault is not None
        else (None, None)
    )
    told |= {"stood_s": stood, "again_s": again}
    sys.stderr.write(f"{json.dumps(told)}\n")
    return told


def _arrived(robot: Child) -> list[Entry]:
    robot.pipe.send("arrived")
    arrived: list[Entry] = robot.pipe.recv()
    return arrived


def _cut(air: Link, robot: Child, other: Child) -> Window:
    """Cut the link while the robot drives."""
    while len(obeyed(_arrived(robot))) < 10 * _CUT_AFTER_S / 2:
        if other.pipe.poll(0.2):
            raise JobError("the run was over before the cut")
    begin_s = time.monotonic()
    air.cut(cut=True)
    time.sleep(CUT_S)
    air.cut(cut=False)
    return Window(begin_s, time.monotonic())


def own(folder: Path) -> list[Record]:
    """Return what each process of a ROS 2 robot's own takes while its camera sends 10 frames a second."""
    with day_with(Robot(folder, size=CAMERA)) as (_, person):
        bus = person.client.node.bus
        pids = {
            name: bus.call(name, "status", Nothing(), Status).pid
            for name in ("robot", "features", "router")
        }
        person.run(1, 20)  # What is loaded at the first frame is not of every frame.
        before = {name: used(pid) for name, pid in pids.items()}
        frames = person.run(1, OWN_FRAMES).ticks
        after = {name: used(pid) for name, pid in pids.items()}
        together_mb = held_once(pids.values()) / 1e6
    taken = [
        {"process": name, "mb": held / 1e6, "ms_a_frame": 1e3 * (took_s - before[name][1]) / frames}
        for name, (held, took_s) in after.items()
    ]
    return [
        *taken,
        {
            "process": "together",
            "mb": together_mb,
            "ms_a_frame": sum(one["ms_a_frame"] for one in taken),
        },
    ]


def held_once(pids: Iterable[int]) -> int:
    """Return the bytes that processes hold: what they share, pages of files as these are, once."""
    own = 0
    files = dict[str, int]()
    for pid in pids:
        for mapping in re.split(r"\n(?=[0-9a-f]+-)", Path(f"/proc/{pid}/smaps").read_text()):
            held, changed = (
                1024 * int(re.findall(rf"^{name}: +(\d+)", mapping, re.M)[0]) for name in _HELD
            )
            _, _, at, device, inode, *_ = mapping.split()
            place = f"{at} {device} {inode}" if inode != "0" else f"{pid} {mapping.split()[0]}"
            files[place] = max(files.get(place, 0), held - changed)
            own += changed
    return own + sum(files.values())


def main(arguments: list[str]) -> None:
    """Read the flags, drive, print and write."""
    parser = Parser("link", __doc__)
    parser.add_model()
    names = [*(row.name for row in ROWS), "own"]
    parser.add_argument(
        "--row", action="append", default=[], choices=names, help="only this; may be repeated"
    )
    chosen = parser.parse(arguments)
    if chosen.model is not None:
        options.read_model(chosen.model, options.Use("filter"))
    wanted = chosen.row or (QUICK if chosen.quick else names)
    with folder_for(chosen.out) as folder:
        taking = own(folder / "own") if "own" in wanted else []
        model = (
            chosen.model or taught(folder / "taught", 1, 0, WORLD, "{}x{}".format(*CAMERA))
        ).resolve()
        rows = [
            run(row, model, folder / row.name.replace(", ", "-"))
            for row in ROWS
            if row.name in wanted
        ]
    text = table("a run", rows) + table("what a robot's own processes take", taking)
    say(chosen, {"benchmark": "link", "runs": rows, "own": taking}, text)
