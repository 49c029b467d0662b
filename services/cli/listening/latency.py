"""How long a command takes from the frame that it answers, hop by hop, as one observer sees the messages arrive.

Pure: it is told what arrived when, on one clock, and gives the spread of each hop. All of a tick that arrives before
its frame is ignored: the observer came in the middle of it. What arrives twice counts once, the first time: a frame
that lockstep sends again because an answer was lost has taken as long as that, and so it is for the actuator too.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from schemas.base import SOURCES, Message, Source
from schemas.command import CommandApplied
from schemas.topics import ACTION, APPLIED, COMMANDS, OBSERVATION, STATE
from services.kit.tables import number

Hop = tuple[str, str]
FRAME: Final = "frame"
#: Not a message: what the actuator says of itself, on its own clock.
ACCEPTED: Final[Hop] = (FRAME, "accepted")
#: What a source waits for before it commands, in this order; a person at the keys waits for nothing but the frame.
CAUSES: Final[dict[Source, tuple[str, ...]]] = {
    "policy": (OBSERVATION.name, STATE.name),
    "expert": (OBSERVATION.name,),
}
#: Sources that drive; an emergency stop answers no frame.
DRIVERS: Final = tuple(source for source in SOURCES if source != "emergency_stop")
#: Ticks whose messages may still come. A command as old as this many frames has long been refused as stale.
OPEN_TICKS: Final = 100


@dataclass(frozen=True)
class Spread:
    """Durations of one hop."""

    ticks: int
    p50_ms: float
    p95_ms: float
    max_ms: float

    @classmethod
    def of(cls, durations_s: Iterable[float]) -> Spread:
        """Summarize at least one duration."""
        ms = 1e3 * np.fromiter(durations_s, float)
        p50, p95 = np.percentile(ms, [50, 95])
        return cls(len(ms), float(p50), float(p95), float(ms.max()))


#: The hops of one driver that were measured, in the order of the chain.
Breakdown = dict[Hop, Spread]


@dataclass
class _Tick:
    """First arrivals of the messages of one tick."""

    frame_s: float
    arrived_s: dict[str, float] = field(default_factory=dict)
    applied_s: dict[Source, float] = field(default_factory=dict)
    accepted_s: dict[Source, float] = field(default_factory=dict)

    def durations(self, driver: Source) -> Iterator[tuple[Hop, float]]:
        """Yield the hops on the way to one driver's command, and beyond it; nothing where it sent none."""
        command = COMMANDS[driver].name
        if command not in self.arrived_s:
            return
        at_s = {FRAME: self.frame_s} | self.arrived_s
        if driver in self.applied_s:
            at_s[APPLIED.name] = self.applied_s[driver]
        for start, end in hops(driver):
            if start in at_s and end in at_s:
                yield (start, end), at_s[end] - at_s[start]
        if driver in self.accepted_s:
            yield ACCEPTED, self.accepted_s[driver]


class LatencyTrace:
    """Collects arrivals; a few numbers for each tick are kept, however long it goes on."""

    def __init__(self) -> None:
        self.frames = 0
        #: Commands of drivers, whether or not their frame was seen.
        self.commands = 0
        #: Messages that could not be decoded, counted by who listens.
        self.bad = 0
        self._open: dict[tuple[str, int], _Tick] = {}
        self._durations_s: defaultdict[tuple[Source, bool, Hop], array[float]] = defaultdict(lambda: array("d"))

    def frame(self, header: Message, at_s: float) -> None:
        """Begin a tick: its frame was captured."""
        key = (header.episode, header.tick)
        if key in self._open:
            return
        self.frames += 1
        self._open[key] = _Tick(at_s)
        if len(self._open) > OPEN_TICKS:
            self._close(self._open.pop(next(iter(self._open))))

    def arrived(self, topic: str, header: Message, at_s: float) -> None:
        """Note an observation, a state, an action or a command."""
        self.commands += topic in _COMMAND_NAMES
        tick = self._open.get((header.episode, header.tick))
        if tick is not None:
            tick.arrived_s.setdefault(topic, at_s)

    def applied(self, message: CommandApplied, at_s: float) -> None:
        """Note what the actuator does; it belongs to the frame that the obeyed command answered."""
        if message.source is None or message.reason != "command" or message.answered_tick is None:
            return
        tick = self._open.get((message.episode, message.answered_tick))
        if tick is not None and message.source not in tick.applied_s:
            tick.applied_s[message.source] = at_s
            if message.latency_ns is not None:
                tick.accepted_s[message.source] = message.latency_ns * 1e-9

    def finish(self) -> None:
        """Count the ticks that are still open; nothing more will arrive."""
        while self._open:
            self._close(self._open.pop(next(iter(self._open))))

    def drivers(self) -> list[Source]:
        """Return who commanded."""
        return [driver for driver in DRIVERS if self.breakdown(driver)]

    def breakdown(self, driver: Source, *, decisions_only: bool = False) -> Breakdown:
        """Return the spread of each hop of a driver, over all ticks or only over those with a decision."""
        which = (True,) if decisions_only else (False, True)
        found: Breakdown = {}
        for hop in (*hops(driver), ACCEPTED):
            parts = [
                self._durations_s[key] for decided in which if (key := (driver, decided, hop)) in self._durations_s
            ]
            if parts:
                found[hop] = Spread.of(duration_s for part in parts for duration_s in part)
        return found

    def _close(self, tick: _Tick) -> None:
        decided = ACTION.name in tick.arrived_s
        for driver in DRIVERS:
            for hop, duration_s in tick.durations(driver):
                self._durations_s[driver, decided, hop].append(duration_s)


_COMMAND_NAMES: Final = frozenset(COMMANDS[driver].name for driver in DRIVERS)


def hops(driver: Source) -> list[Hop]:
    """Return the hops of a driver: up to its command, then their sum, then on to the actuator."""
    command = COMMANDS[driver].name
    chain = list(pairwise((FRAME, *CAUSES.get(driver, ()), command)))
    return [*dict.fromkeys((*chain, (FRAME, command))), (command, APPLIED.name)]


def record(found: Breakdown) -> list[dict[str, object]]:
    """Return a breakdown for JSON."""
    return [{"from": start, "to": end} | asdict(spread) for (start, end), spread in found.items()]


def rows(title: str, found: Breakdown) -> Iterator[list[str]]:
    """Yield a breakdown as the rows of a table for people: a line of headings, then one line a hop."""
    yield [title, "ticks", "p50 ms", "p95 ms", "max ms"]
    for (start, end), spread in found.items():
        note = ", on the actuator's clock" if (start, end) == ACCEPTED else ""
        figures = map(number, (spread.p50_ms, spread.p95_ms, spread.max_ms))
        yield [f"  {start} -> {end}{note}", str(spread.ticks), *figures]
