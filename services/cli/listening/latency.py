"""How long a command takes from the frame that it answers, hop by hop, as one observer sees the messages arrive.

Pure: it is told what arrived when, on one clock, and gives the spread of each hop. All of a tick that arrives before
its frame is ignored: the observer came in the middle of it. What arrives twice counts once, the first time: a frame
that lockstep sends again because an answer was lost has taken as long as that, and so it is for the actuator too.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final

import numpy as np

from schemas.base import SOURCES, Message, Source
from schemas.command import CommandApplied
from schemas.topics import APPLIED, COMMANDS, OBSERVATION, STATE
from services.kit.tables import number

Hop = tuple[str, str]
#: Of each hop that was measured, in the order of the chain: ticks, p50_ms, p95_ms, max_ms.
Breakdown = dict[Hop, dict[str, Any]]
FRAME: Final = "frame"
#: Not a message: what the actuator says of itself, on its own clock.
ACCEPTED: Final = "accepted"
#: What a source waits for before it commands, in this order; a person at the keys waits for nothing but the frame.
CAUSES: Final[dict[Source, tuple[str, ...]]] = {"policy": (OBSERVATION.name, STATE.name), "expert": (OBSERVATION.name,)}
#: Sources that drive, with the topics of their commands; an emergency stop answers no frame.
DRIVERS: Final[dict[Source, str]] = {source: COMMANDS[source].name for source in SOURCES if source != "emergency_stop"}


class LatencyTrace:
    """Collects arrivals: of each tick that began here, when each of its messages came first.

    `frames` is the name of the topic whose messages begin a tick.
    """

    def __init__(self, frames: str) -> None:
        #: Commands of drivers, whether or not their frame was seen.
        self.commands = 0
        self._frames = frames
        self._ticks_s: dict[tuple[str, int], dict[str, float]] = {}

    @property
    def frames(self) -> int:
        """How many ticks began."""
        return len(self._ticks_s)

    def see(self, message: Message, at_s: float) -> None:
        """Note a message that came at a time; what the actuator does belongs to the frame that it answers."""
        topic, tick = message.topic_name, message.tick
        self.commands += topic in DRIVERS.values()
        if topic == self._frames:
            self._ticks_s.setdefault((message.episode, tick), {FRAME: at_s})
        if isinstance(message, CommandApplied):
            obeyed = message.source is not None and message.reason == "command"
            tick = message.answered_tick if obeyed and message.answered_tick is not None else -1
        seen_s = self._ticks_s.get((message.episode, tick), {})
        if not isinstance(message, CommandApplied):
            seen_s.setdefault(topic, at_s)
        elif seen_s and f"{topic} of {message.source}" not in seen_s:
            seen_s[f"{topic} of {message.source}"] = at_s
            if message.latency_ns is not None:
                seen_s[f"{ACCEPTED} of {message.source}"] = seen_s[FRAME] + 1e-9 * message.latency_ns

    def drivers(self) -> list[Source]:
        """Return who commanded."""
        return [driver for driver in DRIVERS if self.breakdown(driver)]

    def breakdown(self, driver: Source) -> Breakdown:
        """Return the spread of each hop of a driver."""
        ticks_s = [seen_s for seen_s in self._ticks_s.values() if DRIVERS[driver] in seen_s]
        found: Breakdown = {}
        for hop in hops(driver):
            # What the actuator says is of one driver.
            start, end = (f"{name} of {driver}" if name in (APPLIED.name, ACCEPTED) else name for name in hop)
            ms = [1e3 * (seen_s[end] - seen_s[start]) for seen_s in ticks_s if start in seen_s and end in seen_s]
            if ms:
                p50, p95 = np.percentile(ms, [50, 95]).tolist()
                found[hop] = {"ticks": len(ms), "p50_ms": p50, "p95_ms": p95, "max_ms": max(ms)}
        return found


def hops(driver: Source) -> list[Hop]:
    """Return the hops of a driver: up to its command, then their sum, then on to the actuator, and what that says."""
    command = DRIVERS[driver]
    chain = list(pairwise((FRAME, *CAUSES.get(driver, ()), command)))
    return [*dict.fromkeys((*chain, (FRAME, command))), (command, APPLIED.name), (FRAME, ACCEPTED)]


def rows(title: str, found: Breakdown) -> Iterator[list[str]]:
    """Yield a breakdown as the rows of a table for people: a line of headings, then one line a hop."""
    yield [title, "ticks", "p50 ms", "p95 ms", "max ms"]
    for (start, end), spread in found.items():
        note = ", on the actuator's clock" if end == ACCEPTED else ""
        figures = (number(spread[name]) for name in ("p50_ms", "p95_ms", "max_ms"))
        yield [f"  {start} -> {end}{note}", str(spread["ticks"]), *figures]
