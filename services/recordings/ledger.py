"""Account for the messages of an episode: repeated messages and missing ticks."""

from array import array
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterator
from typing import Final, get_args

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode, EventName
from schemas.topics import APPLIED, JPEG, POSE, STATE

#: Topics with a message for every tick. The last tick has no applied command, and not always a
#: state.
EVERY_TICK: Final = (JPEG.name, POSE.name, STATE.name, APPLIED.name)
TO_THE_END: Final = (JPEG.name, POSE.name)
_EVENTS: Final = get_args(EventName)  # In their order within a tick.

#: Maximum number of recorded messages of a topic within a tick: ten per second for a quarter of an
#: hour, half a kilobyte of memory each.
_MOST_PLACES: Final = 10_000


def place_of(message: Message) -> int:
    """Return the unique place of a message within its topic and tick."""
    if isinstance(message, Episode):
        return _EVENTS.index(message.event)
    return message.sequence if isinstance(message, Command | CommandApplied) else 0


class Spans:
    """A set of integers as spans: a drive of hours without a gap is a single span."""

    def __init__(self) -> None:
        #: Ascending: the first number of a span, the first number after it, and so on.
        self._bounds = array("q")
        self.count = 0

    def add(self, number: int) -> bool:
        """Add a number; return whether it is new."""
        if bisect_right(self._bounds, number) % 2:
            return False
        self.count += 1
        for bound in (number, number + 1):
            # Two adjoining spans become one.
            at = bisect_left(self._bounds, bound)
            if at < len(self._bounds) and self._bounds[at] == bound:
                self._bounds.pop(at)
            else:
                self._bounds.insert(at, bound)
        return True

    def missing(self, last: int) -> Iterator[tuple[int, int]]:
        """Yield first and last number of each gap from 0 to `last`."""
        bounds = [0, *self._bounds, last + 1]
        yield from (
            (first, end - 1)
            for first, end in zip(bounds[::2], bounds[1::2], strict=True)
            if first < end
        )


class Ledger:
    """Accounts for the messages of one episode, in any order."""

    def __init__(self) -> None:
        self._seen: defaultdict[tuple[str, int], Spans] = defaultdict(Spans)
        self._ticks = {topic: Spans() for topic in EVERY_TICK}
        self._last: dict[str, int] = dict.fromkeys(EVERY_TICK, -1)
        self.duplicates = 0

    def admit(self, message: Message) -> bool:
        """Return whether a message is new."""
        topic = message.topic_name
        tick = message.tick
        if not self._seen[topic, min(place_of(message), _MOST_PLACES)].add(tick):
            self.duplicates += 1
            return False
        if topic in self._ticks:
            self._ticks[topic].add(tick)
            self._last[topic] = max(self._last[topic], tick)
        return True

    def close(self, end_tick: int) -> None:
        """Note the last tick of the episode, which every recorded topic must reach."""
        for topic in TO_THE_END:
            if self._ticks[topic].count:
                self._last[topic] = max(self._last[topic], end_tick)

    def whole(self, end_tick: int) -> bool:
        """Return whether an episode that ended at this tick is complete."""
        reach = all(
            self._last[topic] >= end_tick for topic in TO_THE_END if self._ticks[topic].count
        )
        return reach and not self.gap_ticks

    @property
    def missing(self) -> dict[str, int]:
        """Number of missing messages of each per-tick topic that has gaps."""
        counts = {
            topic: self._last[topic] + 1 - ticks.count for topic, ticks in self._ticks.items()
        }
        return {topic: count for topic, count in counts.items() if count}

    @property
    def gap_ticks(self) -> int:
        """Number of missing messages of per-tick topics."""
        return sum(self.missing.values())

    def gaps(self) -> dict[str, str]:
        """Return the missing ticks by topic, for example ``{"camera/jpeg": "3-5 9"}``."""
        found = {
            topic: list(ticks.missing(self._last[topic])) for topic, ticks in self._ticks.items()
        }
        return {
            topic: " ".join(_text(*span) for span in spans)
            for topic, spans in found.items()
            if spans
        }


def _text(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}-{last}"
