"""The robot's clock, by ours: bounds of the offset between the two, from round trips of the link."""

import math
from typing import Final

from services.robot.gate import MAX_AGE_S

#: How much the clocks of two computers may drift apart, seconds a second: bounds loosen so fast, but a link that became
#: slow for a minute is not taken for a clock that was set (it makes 12 ms of that).
DRIFT: Final = 200e-6
#: A clock that leaps by more, seconds, was set: a fifth of the age that a frame may have may be wrong, and no more.
LEAP_S: Final = MAX_AGE_S / 5
#: A clock is known after so long, seconds: of what comes in so long something leaves the robot without delay.
LEARN_S: Final = 2.0


class StampedClock:
    """Maps the stamps of one stream of messages to our clock.

    A message was stamped before it arrived: its stamp bounds the offset of the clocks from above. The link delayed it
    by at most a measured time: that bounds the offset from below (Cristian 1989). The tightest bounds are kept, as
    NTP's minimum filter does. `made_s` takes the lower one, so a message counts as older by the round trip, and never
    as newer than it is. Delays inside the robot, before its router has the message, are known by the least one alone.
    """

    def __init__(self) -> None:
        self._most_s: float | None = None
        self._least_s = -math.inf
        self._late_s = 0.0  # How much longer than the fastest the last message took, seconds.
        self._last_stamp_s = 0.0
        self._last_arrived_s = 0.0
        self._since_s = 0.0
        self.leaps = 0  # How many times the other clock seemed to leap.
        self.delay_s = math.inf  # Most that the last message took, seconds.

    @property
    def offset_s(self) -> float | None:
        """Our clock less the other one, at most; None before the first message, and after the clock was set back."""
        return self._most_s

    @property
    def known(self) -> bool:
        """Whether the bounds are of a time that is long enough, since the other clock last seemed to leap."""
        bounded = self._most_s is not None and self._least_s > -math.inf
        return bounded and self._last_arrived_s - self._since_s >= LEARN_S

    def made_s(self, stamp_s: float, arrived_s: float, link_s: float) -> float | None:
        """Return when a message was made, by our clock; None for a message that is not newer than the last one.

        Parameters
        ----------
        stamp_s
            Stamp of the message by the other clock, seconds.
        arrived_s
            Arrival of the message by our clock, seconds.
        link_s
            Upper bound of the delay of the link for this message, seconds; infinity if it is unknown.
        """
        sample_s = arrived_s - stamp_s
        if self._most_s is None:
            self._begin(arrived_s)
            self._most_s = sample_s
        elif stamp_s <= self._last_stamp_s:
            if stamp_s < self._last_stamp_s - LEAP_S:
                self.leaps += 1
                self._most_s = None
            return None
        else:
            drift_s = DRIFT * max(0.0, arrived_s - self._last_arrived_s)
            drifted_s = self._most_s + drift_s
            # Faster than the fastest; or all at once fast, which may also be a late message with a clock set forward;
            # or heard so long ago that nobody knows.
            if drift_s > LEAP_S or sample_s - drifted_s < max(-LEAP_S, self._late_s - MAX_AGE_S):
                self.leaps += 1
                self._begin(arrived_s)
            self._least_s -= drift_s
            self._most_s = min(drifted_s, sample_s)
        self._least_s = max(self._least_s, sample_s - link_s)
        self._last_stamp_s = stamp_s
        self._last_arrived_s = arrived_s
        self._late_s = sample_s - self._most_s
        # A message that left the robot late raises the lower bound too far: the upper one holds all the same.
        self.delay_s = sample_s - min(self._least_s, self._most_s)
        return stamp_s + self._most_s if self._least_s == -math.inf else arrived_s - self.delay_s

    def _begin(self, arrived_s: float) -> None:
        """Begin to learn the clock."""
        self._since_s = arrived_s
        self._least_s = -math.inf
