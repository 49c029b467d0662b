"""Another machine's clock, told by ours."""

from __future__ import annotations

from typing import Final

#: How much the clocks of two computers may drift apart, seconds a second: the least delay seen counts for ever less,
#: but a link that became slow for a minute is not taken for a clock that was set (it makes 12 ms of that).
DRIFT: Final = 200e-6
#: A stamp that lies further back than this, seconds, is of a clock that was set; one that lies less far back is late.
SET_BACK_S: Final = 1.0


class StampedClock:
    """Maps the stamps of one stream of messages to when they were made by our clock.

    The least delay that was seen counts as none. So what is said is never before the truth, and after it by what the
    fastest message took: a few milliseconds in a local network. It is never after the message's arrival.
    """

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._last_stamp_s = 0.0
        self._last_arrived_s = 0.0
        #: How many times the other clock was set back.
        self.set_back = 0
        #: How much longer than the fastest the last message took, seconds.
        self.delay_s = 0.0

    @property
    def offset_s(self) -> float | None:
        """Our clock less the other one; None before the first message."""
        return self._offset_s

    def made_s(self, stamp_s: float, arrived_s: float) -> float | None:
        """Return when a message was made, by our clock; None for one that is not newer than the one before."""
        sample_s = arrived_s - stamp_s
        if self._offset_s is None or stamp_s < self._last_stamp_s - SET_BACK_S:
            self.set_back += self._offset_s is not None
            self._offset_s = sample_s
        elif stamp_s <= self._last_stamp_s:
            return None
        else:
            drifted_s = self._offset_s + DRIFT * max(0.0, arrived_s - self._last_arrived_s)
            self._offset_s = min(drifted_s, sample_s)
        self._last_stamp_s, self._last_arrived_s = stamp_s, arrived_s
        self.delay_s = sample_s - self._offset_s
        return stamp_s + self._offset_s
