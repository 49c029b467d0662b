"""What an episode's recording has and what it lacks: which messages were sent again, which ticks never came."""

from __future__ import annotations

from collections import defaultdict
from typing import Final

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.topics import APPLIED, JPEG, OBSERVATION, POSE, STATE

#: Topics with a message for every tick. At its end an episode has no command applied and perhaps no state any more.
EVERY_TICK: Final = (JPEG.name, POSE.name, OBSERVATION.name, STATE.name, APPLIED.name)
TO_THE_END: Final = (JPEG.name, POSE.name, OBSERVATION.name)

Order = tuple[int, ...]


def order_of(message: Message) -> Order:
    """Return where a message stands among those of its topic and episode; no two have the same place."""
    if isinstance(message, Episode):
        rank = {"started": 0, "ended": 2}.get(message.event, 1)
        return rank, message.tick, ("victim_found", "collision", "timed_out", "started", "ended").index(message.event)
    if isinstance(message, Command | CommandApplied):
        return message.tick, message.sequence
    return (message.tick,)


class Ledger:
    """Keeps account of the messages of one episode.

    A topic has one publisher, whose messages arrive in order. So a message that is not later than the last one was
    sent again (in lockstep a frame is repeated until it is answered), and a tick that is passed over is lost.
    """

    def __init__(self) -> None:
        self._last: dict[str, Order] = {}
        self._gaps: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
        self.duplicates = 0

    def admit(self, message: Message) -> bool:
        """Whether a message is new; if so, the ticks before it that are missing are noted."""
        topic, order = message.topic_name, order_of(message)
        last = self._last.get(topic)
        if last is not None and order <= last:
            self.duplicates += 1
            return False
        self.enter(topic, order)
        return True

    def enter(self, topic: str, order: Order) -> None:
        """Note that the next message of a topic is there."""
        if topic in EVERY_TICK:
            self._miss(topic, self.last_tick(topic) + 1, order[0])
        self._last[topic] = order

    def close(self, end_tick: int) -> None:
        """Note what is missing at the end of an episode that ended at this tick."""
        for topic in TO_THE_END:
            if topic in self._last:
                self._miss(topic, self.last_tick(topic) + 1, end_tick + 1)

    def last_tick(self, topic: str) -> int:
        """Return the tick of the last message of a per-tick topic, -1 before the first."""
        last = self._last.get(topic)
        return -1 if last is None else last[0]

    @property
    def gap_ticks(self) -> int:
        """How many messages of per-tick topics are missing."""
        return sum(last - first + 1 for ranges in self._gaps.values() for first, last in ranges)

    def gaps(self) -> dict[str, str]:
        """Return the missing ticks by topic, for example ``{"camera/rgb": "3-5 9"}``."""
        return {topic: " ".join(_text(*span) for span in spans) for topic, spans in self._gaps.items()}

    def _miss(self, topic: str, first: int, end: int) -> None:
        if first < end:
            self._gaps[topic].append((first, end - 1))


def _text(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}-{last}"
