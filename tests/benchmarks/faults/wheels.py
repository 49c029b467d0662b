"""A moving base in a process of its own, as a real robot's is: it goes on with its last order, whoever is harmed.

It has its own clock, its own watchdog and its own log; orders come as datagrams. No process of the stack that is
frozen, killed or cut off keeps it from moving on.
"""

import json
import os
import secrets
import select
import socket
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from schemas.base import STANDING, Velocity
from services.robot.clock import now_s
from services.simulator.base import STEP_S, Base, KinematicBase, Motion
from services.simulator.body import WATCHDOG_S
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from tests.benchmarks.child import child

#: Motions kept until the robot asks: the longest freeze, 14 s, and as much again for what comes before and after.
_KEPT: Final = round(30.0 / STEP_S)
_LARGEST: Final = 1 << 18  # An answer with all of them, at 120 bytes each.
#: The base answers within a step of its own time; on a busy machine it may have to wait for its turn.
_ANSWER_S: Final = 2.0


@dataclass(frozen=True)
class Step:
    """One step of the base: when it ended, when the last order came, the speed of the faster wheel, and what it did.

    In the file times are by the clock that also passes while the machine is suspended, read by the monotonic one; the
    atom is ``stop`` as well where its watchdog made it stand.
    """

    t_s: float
    ordered_s: float
    speed_m_s: float
    atom: str


def boot_ahead_s() -> float:
    """Return how far the clock of robot and base is ahead of the monotonic one: for how long the machine slept."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()


def read_steps(path: Path, since_s: float) -> list[Step]:
    """Read what a base has done since then, monotonic seconds; it may be in the middle of a line."""
    ahead_s = boot_ahead_s()
    *whole, _rest = path.read_text().split("\n")
    steps = (
        Step(t_s - ahead_s, ordered_s - ahead_s, *rest)
        for t_s, ordered_s, *rest in map(json.loads, whole)
    )
    return [step for step in steps if step.t_s > since_s]


@contextmanager
def rolling(world: str, log: Path) -> Iterator[str]:
    """Have a base move in a world for as long as the context lasts; give the address that orders go to."""
    address = f"smal-wheels-{os.getpid()}-{secrets.token_hex(4)}"
    with child("the moving base", roll, world, address, log):
        yield address


def roll(world: str, address: str, log: Path, owner: Connection) -> None:
    """Move until the owner of the pipe closes it, or dies."""
    base = KinematicBase(load_world(world).place)
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as orders,
        log.open("a", buffering=1) as file,
    ):
        orders.bind(_abstract(address))
        wheels = Wheels(base, file)
        owner.send("ready")
        while True:
            readable, _, _ = select.select(
                [orders, owner], [], [], max(0.0, wheels.due_s - now_s())
            )
            # What was due before an order came is done before: a base that was late does not obey backwards in time.
            wheels.roll_on(now_s())
            if owner in readable:
                return
            if orders in readable:
                payload, sender = orders.recvfrom(_LARGEST)
                answer = wheels.take(json.loads(payload), now_s())
                if answer is not None:
                    with suppress(OSError):  # whoever asked is dead, or does not listen
                        orders.sendto(json.dumps(answer).encode(), socket.MSG_DONTWAIT, sender)


def _abstract(address: str) -> str:
    """Return a name of a socket that is no file."""
    return "\0" + address


class Wheels:
    """A base that is moved by the clock.

    Parameters
    ----------
    base : Base
    log : text file
        A line for every step.
    begin_s : float, optional
        When its time begins; now if not given.
    """

    def __init__(self, base: Base, log: IO[str], begin_s: float | None = None) -> None:
        self._base = base
        self._log = log
        self.due_s = (
            now_s() if begin_s is None else begin_s
        ) + STEP_S  # When the next step is complete.
        self._motions: deque[Motion] = deque(maxlen=_KEPT)
        self._order = STANDING
        self._ordered_s = 0.0
        self._stands_anywhere = True

    def take(self, message: dict[str, Any], at_s: float) -> dict[str, Any] | None:
        """Carry out an order, or answer a question."""
        if "order" in message:
            self._order = Velocity(*message["order"])
            self._ordered_s = at_s
            return None
        if "put" in message:
            self._base.put(Pose(*message["put"]), np.random.default_rng(message["seed"]))
            self._order = STANDING
            self._stands_anywhere = False
            self._motions.clear()
        told = [
            [m.pose.x, m.pose.y, m.pose.heading, *m.rolled_m, m.collided] for m in self._motions
        ]
        self._motions.clear()
        return {"question": message["question"], "motions": told}

    def roll_on(self, until_s: float) -> None:
        """Make the steps that are complete by then."""
        while self.due_s <= until_s:
            if not self._stands_anywhere:
                self._step()
            self.due_s += STEP_S

    def _step(self) -> None:
        minded = self.due_s - self._ordered_s <= WATCHDOG_S
        velocity = self._order if minded else STANDING
        motion = self._base.step(velocity, STEP_S)
        self._motions.append(motion)
        speed_m_s = max(map(abs, motion.rolled_m)) / STEP_S
        step = Step(self.due_s, self._ordered_s, speed_m_s, velocity.atom())
        self._log.write(json.dumps(astuple(step)) + "\n")


class FarBase:
    """The base in the other process, as `services.simulator.base.Base`: its steps are what that one has told.

    Parameters
    ----------
    address : str
        As ``rolling`` gives it.
    """

    def __init__(self, address: str) -> None:
        self._orders, self._questions = (_connected(address) for _ in range(2))
        self._questions.settimeout(_ANSWER_S)
        self._orders.setblocking(False)
        self._asked = 0
        self._told: deque[Motion] = deque()

    @property
    def braking_s(self) -> float:
        """Return 0: it stands at once."""
        return 0.0

    def order(self, velocity: Velocity) -> None:
        """Have it drive from now on; an order for which a base that is not heard has no room is lost, as on a line."""
        with suppress(BlockingIOError):
            self._orders.send(json.dumps({"order": velocity}).encode())

    def put(self, pose: Pose, rng: np.random.Generator) -> None:
        """Stand still at a pose."""
        self._ask(put=[pose.x, pose.y, pose.heading], seed=int(rng.integers(2**62)))
        self._told.clear()

    def fetch(self) -> int:
        """Ask what was done since this was last called; return how many steps."""
        self._told.extend(
            Motion(Pose(x, y, heading), (left, right), bool(collided))
            for x, y, heading, left, right, collided in self._ask()["motions"]
        )
        return len(self._told)

    def step(self, _velocity: Velocity, _duration_s: float) -> Motion:
        """Return the next of the steps that were fetched, whatever is ordered now."""
        return self._told.popleft()

    def _ask(self, **question: object) -> dict[str, Any]:
        self._asked += 1
        self._questions.send(json.dumps({"question": self._asked, **question}).encode())
        while True:
            answer: dict[str, Any] = json.loads(self._questions.recv(_LARGEST))
            if answer["question"] == self._asked:  # not one that came too late
                return answer


def _connected(address: str) -> socket.socket:
    one = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    one.bind("")  # a name of its own, for the answers
    one.connect(_abstract(address))
    return one
