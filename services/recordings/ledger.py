"""What an episode's recording has and what it lacks: which messages were sent again, which ticks never came."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Final

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.topics import APPLIED, JPEG, OBSERVATION, POSE, STATE

#: Topics with a message for every tick. At its end an episode has no command applied and perhaps no state any more.
EVERY_TICK: Final = (JPEG.name, POSE.name, OBSERVATION.name, STATE.name, APPLIED.name)
TO_THE_END: Final = (JPEG.name, POSE.name, OBSERVATION.name)

Order = tuple[int, ...]
#: Messages whose place among their like is more than their tick.
ORDERED: Final[tuple[type[Message], ...]] = (Episode, Command, CommandApplied)


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

    A message may come again: in lockstep a frame is repeated until it is answered, and what is replayed to a recorder
    that was started again may be in an earlier part. It may also come late, after others of its topic.
    """

    def __init__(self) -> None:
        self._seen: defaultdict[str, set[Order]] = defaultdict(set)
        self._ticks: dict[str, set[int]] = {topic: set() for topic in EVERY_TICK}
        self._last: dict[str, int] = dict.fromkeys(EVERY_TICK, -1)
        self.duplicates = 0

    def admit(self, topic: str, order: Order) -> bool:
        """Whether a message is new."""
        if order in self._seen[topic]:
            self.duplicates += 1
            return False
        self._seen[topic].add(order)
        if topic in self._ticks:
            self._ticks[topic].add(order[0])
            self._last[topic] = max(self._last[topic], order[0])
        return True

    def close(self, end_tick: int) -> None:
        """Note that the episode ended at this tick: so far every topic reaches that was recorded at all."""
        for topic in TO_THE_END:
            if self._ticks[topic]:
                self._last[topic] = max(self._last[topic], end_tick)

    def whole(self, end_tick: int) -> bool:
        """Whether nothing is missing of an episode that ended at this tick."""
        return not self.gap_ticks and all(self._last[topic] >= end_tick for topic in TO_THE_END if self._ticks[topic])

    @property
    def gap_ticks(self) -> int:
        """How many messages of per-tick topics are missing."""
        return sum(self._last[topic] + 1 - len(ticks) for topic, ticks in self._ticks.items())

    def gaps(self) -> dict[str, str]:
        """Return the missing ticks by topic, for example ``{"camera/jpeg": "3-5 9"}``."""
        return {topic: text for topic in EVERY_TICK if (text := " ".join(_text(*span) for span in self._spans(topic)))}

    def _spans(self, topic: str) -> Iterator[tuple[int, int]]:
        """Yield first and last tick of each gap."""
        expected = 0
        for tick in [*sorted(self._ticks[topic]), self._last[topic] + 1]:
            if expected < tick:
                yield expected, tick - 1
            expected = tick + 1


def _text(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}-{last}"
