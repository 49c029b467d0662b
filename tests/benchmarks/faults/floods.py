"""Floods: whatever a role may say or ask, as fast as Zenoh takes it, while single emergency stops are sent.

A process floods in the name of one role after the other, of each key that it may put and of each call that it may make
in turn; without certificates in nobody's. Once in each flood one emergency stop is put, a single time, and the
robot's own note tells when it stood for it. The stop's own key is not flooded: whatever comes on it stops the robot.
"""

from __future__ import annotations

import multiprocessing
import random
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, Literal, NamedTuple

import zenoh

from schemas.base import NO_EPISODE
from schemas.command import Command
from schemas.topics import COMMANDS, TOPICS, rpc_key
from services.kit.bus import RpcError
from services.kit.credentials import credentials_in
from services.kit.errors import JobError
from services.table import roles
from tests.benchmarks.faults.child import child
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.rig import ROBOT, Rig
from tests.benchmarks.faults.stop import Stood, Stop, read_notes
from tests.services.secured import open_session

_STOP: Final = COMMANDS["emergency_stop"]
#: A flood lasts so long before a stop is put, seconds: buffers on its way are full then.
_FLOODED_S: Final = (0.4, 0.8)
#: A stop that is not obeyed after so long counts as lost, seconds.
_LOST_S: Final = 5.0
#: Between two floods, seconds: what is under way arrives.
_BETWEEN_S: Final = 0.3
#: How long the robot may take to begin an episode, seconds.
_BEGIN_S: Final = 30.0
#: Messages or calls between two looks at what to flood next.
_ROUND: Final = 50
#: Calls wait so long for their answers, seconds.
_ANSWER_S: Final = 1.0
#: Of who connects on a busy machine.
_PATIENT: Final[dict[str, object]] = {"connect/timeout_ms": 10_000}
#: What is put, and what every call but a status asks: refused by who takes it, so that nothing but its number harms.
_NONSENSE: Final = b"12345678"
#: What a status asks, which is answered.
_NOTHING: Final = b"{}"


class Flood(NamedTuple):
    """What is flooded, by whom."""

    role: str
    kind: Literal["put", "call"]
    key: str

    def __str__(self) -> str:
        """Return it in a few words."""
        return f"{self.kind} of {self.key.split('/', 2)[2]} by {self.role}"


def floods(secure: bool) -> dict[str, list[Flood]]:
    """Return every flood, by who floods: each role with a certificate, or anybody without."""
    if not secure:
        puts = [topic.key(ROBOT) for topic in TOPICS.values() if topic is not _STOP]
        calls = {name for role in roles().values() for name in role.serves}
        return {"anybody": _floods("anybody", puts, calls)}
    found = {
        role.name: _floods(role.name, [one.key(ROBOT) for one in role.gives if one is not _STOP], set(role.calls))
        for role in roles().values()
    }
    return {role: of_it for role, of_it in found.items() if of_it}


def _floods(role: str, puts: list[str], calls: set[str]) -> list[Flood]:
    asked = [rpc_key(ROBOT, *name.split("/", 1)) for name in sorted(calls)]
    return [*(Flood(role, "put", key) for key in puts), *(Flood(role, "call", key) for key in asked)]


def flooded(rig: Rig) -> Window:
    """Flood, and stop the robot once in each flood; the stops are left with the rig."""
    chance = random.Random(1)  # noqa: S311 - when a stop comes
    begin_s = time.monotonic()
    for role, of_it in floods(rig.plan.secure is not None).items():
        with _flooder(rig, role) as flooder:
            for flood in of_it:
                rig.stops.append(_stop_in(rig, flood, flooder, chance.uniform(*_FLOODED_S)))
    return Window(begin_s, time.monotonic())


def _stop_in(rig: Rig, flood: Flood, flooder: Connection, after_s: float) -> Stop:
    """Put one stop into a flood, and wait until the robot stands for it."""
    rig.hold(_BETWEEN_S)
    number = len(rig.stops) + 1
    notes = rig.plan.notes
    if number == 1 or (last := read_notes(notes).get(number - 1)) is None or last.stood_s is None:
        with suppress(RpcError):
            rig.resume()
        rig.begin(_BEGIN_S)
    flooder.send(flood)
    rig.hold(after_s)
    put_s = time.monotonic()
    rig.bus.publish(
        Command(
            robot=ROBOT, episode=NO_EPISODE, tick=0, stamp_ns=0, source="emergency_stop", sequence=number, atom="stop"
        )
    )

    def stood() -> Stood | None:
        return read_notes(notes).get(number)

    rig.until(lambda: (one := stood()) is not None and one.stood_s is not None, _LOST_S)
    flooder.send(None)
    if not flooder.poll(_LOST_S):
        raise JobError(f"the {flood} hangs")
    rate_hz = flooder.recv()
    found = stood()
    return Stop(str(flood), rate_hz, None if found is None else found.at_s - put_s)


@contextmanager
def _flooder(rig: Rig, role: str) -> Iterator[Connection]:
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    with child(f"the flooder {role}", flood_all, rig.bus.endpoint, rig.plan.secure, role, theirs, patience_s=0.0):
        theirs.close()  # so that its end is noticed
        yield ours


def flood_all(endpoint: str, keys: Path | None, role: str, told: Connection, owner: Connection) -> None:
    """Flood what is told, until something else is."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner
    session = open_session(endpoint, None if keys is None else credentials_in(keys, role), _PATIENT)
    owner.send("ready")
    while True:
        flood = told.recv()
        sent, began_s = 0, time.monotonic()
        while not told.poll():
            for _ in range(_ROUND):
                _send(session, flood)
            sent += _ROUND
        told.recv()
        told.send(sent / (time.monotonic() - began_s))


def _send(session: zenoh.Session, flood: Flood) -> None:
    if flood.kind == "put":
        session.put(
            flood.key, _NONSENSE, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK
        )
    else:
        session.get(
            flood.key,
            zenoh.handlers.RingChannel(1),
            payload=_NOTHING if flood.key.endswith("/status") else _NONSENSE,
            timeout=_ANSWER_S,
            priority=zenoh.Priority.REAL_TIME,
        )
