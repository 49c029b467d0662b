"""Judgements over an observer's log; pure, so that each is tested with logs that must fail.

All times are monotonic seconds of the machine, see ``Track``.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from schemas.topics import COMMANDS
from services.robot.clock import TICK_S
from services.simulator.base import STEP_S
from services.simulator.body import WATCHDOG_S
from tests.benchmarks.faults.log import Entry, Step
from tests.benchmarks.faults.track import Interval, Track, answered

#: A command may be obeyed for so long, counted from the capture of the frame that it answers.
VALID_S: Final = 0.5
#: What the stamps may be off by: one step of the physics.
RESOLUTION_S: Final = STEP_S
# What a simulated base does after its process was frozen, in time at full speed: until its watchdog bites, and half of
# the 0.25 s in which it brakes.
_MADE_UP_S: Final = WATCHDOG_S + 0.125 + 2 * RESOLUTION_S
#: A base that does not move for so long stands; as long as from frame to frame.
RESTS_S: Final = TICK_S


@dataclass(frozen=True)
class Window:
    """When a fault lasted."""

    begin_s: float
    end_s: float


@dataclass(frozen=True)
class Still:
    """How long the robot moved after the last valid command.

    On a machine that leaves the robot's process its processor the two differ by a few hundredths of a second.

    Parameters
    ----------
    at_least_s, at_most_s : float
        What the log proves, and what it does not exclude.
    """

    at_least_s: float = 0.0
    at_most_s: float = 0.0

    def worst(self, other: Still) -> Still:
        """Return the worse of both bounds."""
        return Still(max(self.at_least_s, other.at_least_s), max(self.at_most_s, other.at_most_s))


def stand_still(track: Track, fault: Window) -> Still:
    """Return the longest time that the robot moved after the last valid command; 0 if it never moved.

    The command's time is taken as that of the frame which it answers, so the figure is on the safe side by what a
    decision takes.
    """
    worst = Still()
    valid = track.commanded
    stops = [one for one in track.applied if one.told["reason"] != "command"]
    for interval in (one for one in track.intervals() if one.moved_s > 0.0):
        told = [track.captured_s[answered(one)] for one in valid if _known(one, track, interval)]
        # A robot that moves without any command: since the beginning.
        since_s = max(told, default=min(track.captured_s.values()))
        soonest_s, latest_s = _ended_s(interval, stops, fault)
        worst = worst.worst(Still(soonest_s - since_s, latest_s - since_s))
    return worst


def _known(command: Entry, track: Track, interval: Interval) -> bool:
    """Whether a command was there in an interval: told of then, or with the next frame where it changed nothing."""
    accepted_in_time = _accepted_s(command, track) <= interval.end_s
    return command.tick <= interval.tick or (command.tick == interval.tick + 1 and accepted_in_time)


def _accepted_s(command: Entry, track: Track) -> float:
    return track.captured_s[answered(command)] + command.told.get("latency_ns", 0) / 1e9


def _ended_s(interval: Interval, stops: Iterable[Entry], fault: Window) -> tuple[float, float]:
    """Return when the movement in an interval ended at the soonest, and at the latest.

    It began with the interval, and went on for as long as the way tells. Where the robot's process had no processor for
    more than a tick, it may as well have been the end of the interval; at the latest when the actuator said that it
    stops, by the arrival of the message.
    """
    soonest_s = interval.begin_s + interval.moved_s
    if interval.end_s - interval.begin_s <= 2 * TICK_S:
        return soonest_s, soonest_s
    # Less than a tick of slack: times are late by a frame's way to the observer.
    if interval.begin_s - TICK_S < fault.begin_s < interval.end_s and soonest_s <= fault.begin_s + _MADE_UP_S:
        # The robot's process was frozen here: its simulated base went on until its watchdog bit.
        return soonest_s, soonest_s
    said_s = [one.t_s for one in stops if one.tick == interval.tick]
    return soonest_s, max(soonest_s, min([interval.end_s, *said_s]))


def stale(track: Track) -> list[str]:
    """Name the commands that were obeyed although their frame was older than ``VALID_S`` by the stamps."""
    return [
        f"{track.episode}: frame {one.tick} obeyed the command for frame {answered(one)}, {age_s:.2f} s old"
        for one in track.commanded
        if (age_s := track.captured_s[one.tick] - track.captured_s[answered(one)]) > VALID_S
    ]


# -- by the log of a moving base --------------------------------------------------------------------------------------


def commands(tracks: Iterable[Track]) -> dict[str, list[float]]:
    """Return when the frames were captured for which the driver asked for each movement, in order.

    By the driver's own messages, as the observer saw them: not by what the actuator says.
    """
    captured: defaultdict[str, list[float]] = defaultdict(list)
    for track in tracks:
        for one in track.topics[COMMANDS["policy"].name].values():
            captured[one.told["atom"]].append(track.captured_s[one.tick])
    return {atom: sorted(times) for atom, times in captured.items()}


def _last_s(times: list[float], until_s: float) -> float:
    """Return the last of the sorted times until then."""
    before = bisect.bisect_right(times, until_s)
    return times[before - 1] if before else -math.inf


def rolled_on(steps: Iterable[Step], asked: Mapping[str, list[float]]) -> Still:
    """Return the longest time that the base moved after the last valid command for just this movement."""
    moved_s = max((one.t_s - _last_s(asked.get(one.atom, []), one.t_s) for one in steps if one.speed_m_s), default=0.0)
    return Still(moved_s, moved_s)


def stale_orders(steps: Iterable[Step], asked: Mapping[str, list[float]]) -> list[str]:
    """Name the orders that moved the base and that no valid command of the driver had asked for."""
    orders = {one.ordered_s: one.atom for one in steps if one.speed_m_s}
    return [
        f"the base obeyed {atom} at {at_s:.3f} s, asked for {at_s - _last_s(asked.get(atom, []), at_s):.2f} s before"
        for at_s, atom in orders.items()
        if at_s - _last_s(asked.get(atom, []), at_s) > VALID_S
    ]


def stood_s(steps: Iterable[Step], fault: Window) -> tuple[float | None, float | None]:
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


def moved_on_s(steps: Iterable[Step], fault: Window) -> float:
    """Return how long after the begin of a fault, and before its end, the base last moved; 0 where it stood already."""
    moving = [one.t_s for one in steps if one.speed_m_s and fault.begin_s <= one.t_s <= fault.end_s]
    return max(moving, default=fault.begin_s) - fault.begin_s


def refused(track: Track) -> int:
    """Return how many commands the actuator refused."""
    return max((int(one.told.get("refused", 0)) for one in track.applied), default=0)


def obeyed_s(track: Track) -> list[float]:
    """Return when each newly answered frame's command was accepted, in order."""
    times: dict[int, float] = {}
    for one in track.commanded:
        times.setdefault(answered(one), _accepted_s(one, track))
    return sorted(times.values())


def recovery_s(tracks: Iterable[Track], fault_end_s: float) -> float | None:
    """Return how long after the fault the actuator first obeyed a command for a frame captured after it; None: never.

    This is how long the whole loop took to work again, from camera to wheels.
    """
    times = [
        _accepted_s(one, track)
        for track in tracks
        for one in track.commanded
        if track.captured_s[answered(one)] >= fault_end_s
    ]
    return min(times) - fault_end_s if times else None


def flows(tracks: Iterable[Track], since_s: float, commands: int) -> bool:
    """Whether at least so many frames captured since then were answered by commands that were obeyed."""
    return sum(captured >= since_s for track in tracks for captured in _answered_captures(track)) >= commands


def _answered_captures(track: Track) -> list[float]:
    return [track.captured_s[tick] for tick in {answered(one) for one in track.commanded}]


def longest_pause_s(tracks: Iterable[Track], span: Window) -> float:
    """Return the longest time in a span in which no new command was obeyed."""
    times = sorted(t for track in tracks for t in obeyed_s(track) if span.begin_s < t < span.end_s)
    marks = [span.begin_s, *times, span.end_s]
    return max(after - before for before, after in itertools.pairwise(marks))


def rate_hz(tracks: Iterable[Track], topic: str, span: Window) -> float:
    """Return how many messages of a topic arrived in a second of a span."""
    arrived = sum(span.begin_s <= one.t_s < span.end_s for track in tracks for one in track.topics[topic].values())
    return arrived / (span.end_s - span.begin_s)


def moving(track: Track, ticks: int = 3) -> bool:
    """Whether the robot obeyed commands and moved in each of its last intervals."""
    last = track.intervals()[-ticks:]
    obeyed = [one.told["reason"] == "command" for one in track.applied[-ticks:]]
    return len(last) == ticks and all(one.moved_s > TICK_S / 2 for one in last) and all(obeyed)
