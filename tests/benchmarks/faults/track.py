"""One episode as the observer saw it, put in order of the robot's own time."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from schemas.base import NO_EPISODE
from schemas.topics import APPLIED, POSE
from services.robot.clock import TICK_S
from services.simulator.robots import RESCUEBOT
from tests.benchmarks.faults.log import Entry, Order

#: A robot that stands is reported at the same place; what is below this share of a tick's way is no movement.
NOISE: Final = 0.05
_DRIVE: Final = RESCUEBOT.drive


@dataclass(frozen=True)
class Interval:
    """From one frame to the next.

    Parameters
    ----------
    tick : int
        The first of the two.
    begin_s, end_s : float
        When the two were captured, monotonic seconds.
    moved_s : float
        Of this time the robot moved so long, by the way it made: to 3 % of it (its wheels' error).
    """

    tick: int
    begin_s: float
    end_s: float
    moved_s: float


class Track:
    """One episode.

    Stamps tell when a frame was captured by the robot's clock, which runs as the observer's does. How far apart the two
    are is known by the message that arrived soonest, unless it is said. So a time is late by its way to the observer:
    about as long as a frame takes to render, the same for all.

    Parameters
    ----------
    episode : str
    entries : iterable of Entry
        Those of the episode; of a message that came twice the first counts.
    offset_s : float, optional
        From stamps to monotonic seconds, where it is known.
    """

    def __init__(self, episode: str, entries: Iterable[Entry], offset_s: float | None = None) -> None:
        self.episode = episode
        self.topics: defaultdict[str, dict[Order, Entry]] = defaultdict(dict)
        for entry in entries:
            self.topics[entry.topic].setdefault(entry.order, entry)
        everything = [entry for topic in self.topics.values() for entry in topic.values()]
        if offset_s is None:
            offset_s = min((entry.t_s - entry.stamp_ns / 1e9 for entry in everything), default=0.0)
        #: When each frame was captured, monotonic seconds.
        self.captured_s = {entry.tick: entry.stamp_ns / 1e9 + offset_s for entry in everything}

    @property
    def applied(self) -> list[Entry]:
        """What the actuator did, in order."""
        return sorted(self.topics[APPLIED.name].values(), key=lambda entry: entry.order)

    @property
    def commanded(self) -> list[Entry]:
        """Where the actuator obeyed a command whose frame is known, in order."""
        return [one for one in self.applied if one.told["reason"] == "command" and answered(one) in self.captured_s]

    @property
    def poses(self) -> list[Entry]:
        """Where the robot was, in order."""
        return sorted(self.topics[POSE.name].values(), key=lambda entry: entry.tick)

    def intervals(self) -> list[Interval]:
        """Return all pairs of successive frames whose poses are known."""
        found = []
        for a, b in itertools.pairwise(self.poses):
            if b.tick == a.tick + 1:
                begin_s, end_s = self.captured_s[a.tick], self.captured_s[b.tick]
                found.append(Interval(a.tick, begin_s, end_s, _moved_s(a, b, end_s - begin_s)))
        return found


def answered(applied: Entry) -> int:
    """Return the frame whose command was obeyed, -1 for none."""
    tick = applied.told.get("answered_tick")
    return -1 if tick is None else int(tick)


def _moved_s(before: Entry, after: Entry, passed_s: float) -> float:
    """Tell for how long of that time the robot must have moved at its nominal speed."""
    a, b = before.told, after.told
    way_s = math.hypot(b["x_m"] - a["x_m"], b["y_m"] - a["y_m"]) / _DRIVE.speed_m_s
    turn_s = abs(math.remainder(b["heading_rad"] - a["heading_rad"], math.tau)) / _DRIVE.turn_rate_rad_s
    moved_s = max(way_s, turn_s)
    return 0.0 if moved_s < NOISE * TICK_S else min(moved_s, passed_s)


def tracks(entries: Iterable[Entry], offset_s: float | None = None) -> list[Track]:
    """Sort a log into episodes, in order of appearance; for ``offset_s`` see ``Track``."""
    episodes: defaultdict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        if entry.episode != NO_EPISODE:
            episodes[entry.episode].append(entry)
    return [Track(episode, of_it, offset_s) for episode, of_it in episodes.items()]
