"""Floods: whatever a role may say or ask, as fast as Zenoh takes it, while single emergency stops are sent.

A process floods in the name of one role after the other, of each key that it may put and of each call that it may make
in turn; without certificates in nobody's. Once in each flood one emergency stop is put, a single time, and the
robot's own note tells when it stood for it. The stop's own key is not flooded: whatever comes on it stops the robot.

Floods of declarations (tokens, subscribers, queryables) last for 100 stops each. When the router disconnects the
flooder, the flooder connects again and goes on.
"""

import json
import math
import random
import time
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import zenoh
from tqdm import tqdm

from schemas.base import NO_EPISODE
from schemas.command import Command
from schemas.topics import COMMANDS, ROOT, TOPICS, group_key, rpc_key
from services.kit.bus import RpcError
from services.kit.credentials import credentials_in
from services.kit.errors import JobError
from services.robot.loop import STAND_WITHIN_S
from services.table import roles
from tests.benchmarks.child import child
from tests.benchmarks.faults.rig import ROBOT, Rig
from tests.services.secured import open_session

_STOP: Final = COMMANDS["emergency_stop"]
_FLOODED_S: Final = (
    0.4,
    0.8,
)  # A flood lasts so long before a stop is put, seconds: buffers on its way are full then.
_LOST_S: Final = 5.0  # A stop that is not obeyed after so long counts as lost, seconds.
_BETWEEN_S: Final = 0.3  # Between two floods, seconds: what is under way arrives.
STOPS: Final = 100  # In each flood of declarations.
_BEGIN_S: Final = 30.0  # How long the robot may take to begin an episode, seconds.
_ROUND: Final = 50  # Messages or calls between two looks at what to flood next.
_ANSWER_S: Final = 1.0  # Calls wait so long for their answers, seconds.
#: Zenoh settings of a client on a busy machine.
_PATIENT: Final[dict[str, object]] = {"connect/timeout_ms": 10_000}
#: What is put, and what every call but a status asks: refused by who takes it, so that nothing but its number harms.
_NONSENSE: Final = b"12345678"
_NOTHING: Final = b"{}"  # What a status asks, which is answered.


class Flood(NamedTuple):
    """What is flooded, by whom."""

    role: str
    kind: Literal["put", "call", "token", "subscriber", "queryable"]
    key: str
    stops: int = 1

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
        role.name: _floods(
            role.name, [one.key(ROBOT) for one in role.gives if one is not _STOP], set(role.calls)
        )
        for role in roles().values()
    }
    return {role: of_it for role, of_it in found.items() if of_it}


def declared(secure: bool) -> dict[str, list[Flood]]:
    """Return every flood of declarations, by who floods: a role that may declare any number of keys, or anybody."""
    group = group_key(ROBOT, "recognition")
    kinds = [("recognition", "token", group), ("watcher", "subscriber", f"{ROOT}/{ROBOT}/flood"),
             ("recognition", "queryable", group)]  # fmt: skip
    found: dict[str, list[Flood]] = {}
    for role, kind, key in kinds:
        name = role if secure else "anybody"
        found.setdefault(name, []).append(Flood(name, kind, key, STOPS))
    return found


def _floods(role: str, puts: list[str], calls: set[str]) -> list[Flood]:
    asked = [rpc_key(ROBOT, *name.split("/", 1)) for name in sorted(calls)]
    return [
        *(Flood(role, "put", key) for key in puts),
        *(Flood(role, "call", key) for key in asked),
    ]


@dataclass(frozen=True)
class Stop:
    """One emergency stop in a flood of so many messages or calls a second, at its sender.

    ``late_s`` goes from the put of the stop to the robot's standing; None where it was lost.
    """

    flood: str
    rate_hz: float
    late_s: float | None

    @property
    def in_time(self) -> bool:
        """Whether the robot stood as soon as it has to."""
        return self.late_s is not None and self.late_s <= STAND_WITHIN_S


def read_notes(path: Path) -> dict[int, dict[str, float]]:
    """Return what the robot noted of each stop, by its number: ``latched_s``, and ``stood_s`` where an episode ran."""
    stops: dict[int, dict[str, float]] = {}
    *whole, _rest = path.read_text().split("\n")  # the last line may be half written
    for stop, what, at_s in map(json.loads, whole):
        stops.setdefault(stop, {}).setdefault(what, at_s)  # of one that came twice the first counts
    return stops


def flooded(rig: Rig, floods: dict[str, list[Flood]]) -> list[Stop]:
    """Flood, and stop the robot in each flood, by who floods."""
    chance = random.Random(1)  # noqa: S311 - when a stop comes
    stops: list[Stop] = []
    count = sum(flood.stops for of_it in floods.values() for flood in of_it)
    with tqdm(total=count, desc="stops in floods", unit="stop", dynamic_ncols=True) as bar:
        for role, of_it in floods.items():
            with child(
                f"the flooder {role}", flood_all, rig.bus.endpoint, rig.plan.secure, role
            ) as flooder:
                for flood in of_it:
                    stops += _stops_in(rig, flood, flooder.pipe, len(stops) + 1, chance, bar)
    return stops


def _stops_in(
    rig: Rig, flood: Flood, flooder: Connection, first: int, chance: random.Random, bar: "tqdm[Any]"
) -> list[Stop]:
    """Put stops into a flood one after another, and wait each time until the robot stands."""
    rig.hold(_BETWEEN_S)
    _have_it_drive(rig, first - 1)
    flooder.send(flood)
    late: list[float | None] = []
    for number in range(flood.stops):
        late.append(_late_s(rig, first + number, chance.uniform(*_FLOODED_S)))
        if not Stop(str(flood), math.nan, late[-1]).in_time:
            tqdm.write(f"{flood}: stop {number + 1} took {late[-1]} s")
        bar.update()
    flooder.send(None)
    if not flooder.poll(_LOST_S):
        raise JobError(f"the {flood} hangs")
    rate_hz = flooder.recv()
    return [Stop(str(flood), rate_hz, late_s) for late_s in late]


def _have_it_drive(rig: Rig, stop: int) -> None:
    """Have the robot drive, after the stop of this number; the end of an episode may get lost in a flood."""
    stood = "stood_s" in _noted(rig, stop)
    if not stood:
        with suppress(RpcError):
            rig.resume()
    if not stood or rig.ended():
        rig.begin(_BEGIN_S)


def _late_s(rig: Rig, number: int, after_s: float) -> float | None:
    """Put a stop after some time; return when the robot stood for it, seconds, or None if it was lost."""
    _have_it_drive(rig, number - 1)
    rig.hold(after_s)
    put_s = time.monotonic()
    rig.bus.publish(
        Command(
            robot=ROBOT,
            episode=NO_EPISODE,
            tick=0,
            stamp_ns=0,
            source="emergency_stop",
            sequence=number,
            atom="stop",
        )
    )
    rig.until(lambda: "stood_s" in _noted(rig, number), _LOST_S)
    # While no episode runs the robot stands anyway.
    at_s = _noted(rig, number).get("stood_s", _noted(rig, number).get("latched_s"))
    return (
        None if at_s is None else max(0.0, at_s - put_s)
    )  # It may have stood before, for another reason.


def _noted(rig: Rig, stop: int) -> dict[str, float]:
    return read_notes(rig.plan.notes).get(stop, {})


def flood_all(endpoint: str, keys: Path | None, role: str, told: Connection) -> None:
    """Flood what is told, until something else is; ends where nobody tells any more."""
    credentials = None if keys is None else credentials_in(keys, role)
    session = open_session(endpoint, credentials, _PATIENT)
    told.send("ready")
    with suppress(EOFError, OSError):
        while flood := told.recv():
            sent = 0
            began_s = time.monotonic()
            while not told.poll():
                if not session.info.routers_zid():  # disconnected
                    with suppress(zenoh.ZError):
                        session.close()
                        session = open_session(endpoint, credentials, _PATIENT)
                for _ in range(_ROUND):
                    _send(session, flood, sent)
                    sent += 1
            told.recv()
            told.send(sent / (time.monotonic() - began_s))


def _send(session: zenoh.Session, flood: Flood, number: int) -> None:
    if flood.kind in ("put", "call"):
        _message(session, flood)
        return
    key = f"{flood.key}/{number:08x}-1"
    with suppress(zenoh.ZError):  # without a connection
        if flood.kind == "token":
            session.liveliness().declare_token(key)
        elif flood.kind == "subscriber":
            session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        else:
            session.declare_queryable(key, zenoh.handlers.RingChannel(1))


def _message(session: zenoh.Session, flood: Flood) -> None:
    if flood.kind == "put":
        session.put(
            flood.key,
            _NONSENSE,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
    else:
        session.get(
            flood.key,
            zenoh.handlers.RingChannel(1),
            payload=_NOTHING if flood.key.endswith("/status") else _NONSENSE,
            timeout=_ANSWER_S,
            priority=zenoh.Priority.REAL_TIME,
        )
