"""Judgements over what was observed and what the base did; pure, so that each is tested with logs that must fail.

All times are monotonic seconds of the machine.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from schemas.base import TICK_S, Message
from schemas.topics import APPLIED, COMMANDS

VALID_S: Final = 0.5  # A command may be obeyed for so long, counted from the capture of the frame that it answers.
# A base that does not move for so long stands; as long as from frame to frame.
RESTS_S: Final = TICK_S
_TOLD: Final = ("sequence", "event", "outcome", "atom", "reason", "answered_tick", "latency_ns")


class Window(NamedTuple):
    """When a fault lasted."""

    begin_s: float
    end_s: float


@dataclass(frozen=True)
class Entry:
    """One message as it was observed.

    Parameters
    ----------
    t_s, captured_s : float
        When it arrived, and when the frame that it is about was captured.
    topic, episode, tick
        As in the message.
    told : dict
        What of the message is judged.
    """

    t_s: float
    captured_s: float
    topic: str
    episode: str
    tick: int
    told: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, message: Message, t_s: float, clock_ahead_s: float) -> Entry:
        """Note a message that arrived at ``t_s``, whose stamps are of a clock that is ahead by so much."""
        told = {
            name: value for name in _TOLD if (value := getattr(message, name, None)) is not None
        }
        captured_s = message.stamp_ns / 1e9 - clock_ahead_s
        return cls(t_s, captured_s, message.topic_name, message.episode, message.tick, told)


class Obeyed(NamedTuple):
    """A frame whose command was obeyed: when it was captured, and when the command was accepted."""

    captured_s: float
    accepted_s: float


def obeyed(entries: Iterable[Entry]) -> list[Obeyed]:
    """Return the frames whose commands were obeyed, by what the actuator says, in order of acceptance."""
    entries = list(entries)
    captured = {(one.episode, one.tick): one.captured_s for one in entries}
    found: dict[tuple[str, int], Obeyed] = {}
    for one in entries:
        frame = one.episode, one.told.get("answered_tick", -1)
        if one.topic == APPLIED.name and one.told["reason"] == "command" and frame in captured:
            accepted_s = captured[frame] + one.told.get("latency_ns", 0) / 1e9
            found.setdefault(frame, Obeyed(captured[frame], accepted_s))
    return sorted(found.values(), key=lambda one: one.accepted_s)


def asked(entries: Iterable[Entry]) -> dict[str, list[float]]:
    """Return when the frames were captured for which the driver asked for each movement, in order.

    By the driver's own messages: not by what the actuator says.
    """
    captured: defaultdict[str, list[float]] = defaultdict(list)
    for one in entries:
        if one.topic in (COMMANDS["policy"].name, COMMANDS["teleop"].name):
            captured[one.told["atom"]].append(one.captured_s)
    return {atom: sorted(times) for atom, times in captured.items()}


def _since_s(times: list[float] | None, at_s: float) -> float:
    """Return how long before a time the last of the sorted ones was."""
    before = bisect.bisect_right(times or [], at_s)
    return at_s - times[before - 1] if times and before else math.inf


def still_s(steps: Iterable[Any], asked_s: Mapping[str, list[float]]) -> float:
    """Return the longest time that the base moved after the last valid command for just this movement."""
    return max(
        (_since_s(asked_s.get(one.atom), one.t_s) for one in steps if one.speed_m_s), default=0.0
    )


def stale_orders(steps: Iterable[Any], asked_s: Mapping[str, list[float]]) -> list[str]:
    """Name the orders that moved the base and that no valid command of the driver had asked for."""
    orders = {one.ordered_s: one.atom for one in steps if one.speed_m_s}
    ages_s = {at_s: _since_s(asked_s.get(atom), at_s) for at_s, atom in orders.items()}
    return [f"the base obeyed {orders[at_s]} at {at_s:.3f} s, asked for {age_s:.2f} s before"
            for at_s, age_s in ages_s.items() if age_s > VALID_S]  # fmt: skip


def stood_s(steps: Iterable[Any], fault: Window) -> tuple[float | None, float | None]:
    """Return how long after its begin a fault made the base stand, and how long after its end it moved again.

    None where it did not move when the fault began; and where it did not move again.
    """
    moving = [one.t_s for one in steps if one.speed_m_s]
    before = [t_s for t_s in moving if fault.begin_s - RESTS_S <= t_s <= fault.begin_s]
    if not before:
        return None, None
    last_s = before[-1]
    for t_s in moving:
        if t_s > last_s + RESTS_S:
            return max(0.0, last_s - fault.begin_s), t_s - fault.end_s
        last_s = max(last_s, t_s)
    return max(0.0, last_s - fault.begin_s), None


def moved_on_s(steps: Iterable[Any], fault: Window) -> float:
    """Return how long after the begin of a fault, and before its end, the base last moved; 0 where it stood already."""
    moving = [one.t_s for one in steps if one.speed_m_s and fault.begin_s <= one.t_s <= fault.end_s]
    return max(moving, default=fault.begin_s) - fault.begin_s


def recovery_s(frames: Iterable[Obeyed], fault_end_s: float) -> float | None:
    """Return how long after the fault the actuator first obeyed a command for a frame captured after it; None: never.

    This is how long the whole loop took to work again, from camera to wheels.
    """
    times = [one.accepted_s for one in frames if one.captured_s >= fault_end_s]
    return min(times) - fault_end_s if times else None


def longest_pause_s(frames: Iterable[Obeyed], span: Window) -> float:
    """Return the longest time in a span in which no new command was obeyed."""
    times = sorted(one.accepted_s for one in frames if span.begin_s < one.accepted_s < span.end_s)
    return max(
        after - before for before, after in itertools.pairwise([span.begin_s, *times, span.end_s])
    )


def rate_hz(entries: Iterable[Entry], topic: str, span: Window) -> float:
    """Return how many messages of a topic arrived in a second of a span."""
    arrived = sum(one.topic == topic and span.begin_s <= one.t_s < span.end_s for one in entries)
    return arrived / (span.end_s - span.begin_s)


def drives(entries: Sequence[Entry], episode: str | None, commands: int = 3) -> bool:
    """Whether the robot's last commands of an episode were obeyed and moved it."""
    last = [one.told for one in entries if (one.topic, one.episode) == (APPLIED.name, episode)][
        -commands:
    ]
    return len(last) == commands and all(
        told["reason"] == "command" and told["atom"] != "stop" for told in last
    )
