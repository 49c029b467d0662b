"""Mapping of the robot's clock to ours: bounds of their offset, from round trips of the link."""

import math
from typing import Final

from services.robot.gate import MAX_AGE_S

#: Maximum drift between two computers' clocks, seconds a second. Bounds loosen at this rate, but a
#: minute of a slow link (12 ms) does not count as a clock change.
DRIFT: Final = 200e-6
#: Leap of a clock that counts as a change, seconds: a fifth of a frame's maximum age, which bounds
#: the error.
LEAP_S: Final = MAX_AGE_S / 5
#: Time to learn a clock, seconds: within it some message leaves the robot without delay.
LEARN_S: Final = 2.0


class StampedClock:
    """Maps the stamps of one stream of messages to our clock.

    A message was stamped before it arrived: its stamp bounds the offset of the clocks from above.
    The link delayed it by at most a measured time, which bounds the offset from below (Cristian
    1989). The tightest bounds are kept, as in NTP's minimum filter. `made_s` uses the lower one, so
    a message counts as older by the round trip, and never as newer than it is. Delays inside the
    robot, before its router has the message, are known only by the smallest one.
    """

    def __init__(self) -> None:
        self._most_s: float | None = None
        self._least_s = -math.inf
        self._late_s = 0.0  # Delay of the last message beyond the fastest, seconds.
        self._last_stamp_s = 0.0
        self._last_arrived_s = 0.0
        self._since_s = 0.0
        self.leaps = 0  # Number of apparent leaps of the other clock.
        self.delay_s = math.inf  # Maximum delay of the last message, seconds.

    @property
    def offset_s(self) -> float | None:
        """Upper bound of our clock minus the other one; None before the first message."""
        return self._most_s

    @property
    def known(self) -> bool:
        """Return whether the bounds cover `LEARN_S` since the other clock's last apparent leap."""
        bounded = self._most_s is not None and self._least_s > -math.inf
        return bounded and self._last_arrived_s - self._since_s >= LEARN_S

    def made_s(self, stamp_s: float, arrived_s: float, link_s: float) -> float | None:
        """Return when a message was made, by our clock; None unless it is newer than the last one.

        Parameters
        ----------
        stamp_s
            Stamp of the message by the other clock, seconds.
        arrived_s
            Arrival of the message by our clock, seconds.
        link_s
            Upper bound of the delay of the link for this message, seconds; infinity if it is
            unknown.
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
            # Faster than the fastest; or suddenly fast, which can also be a late message after the
            # clock was set forward; or the last message is too old to decide.
            if drift_s > LEAP_S or sample_s - drifted_s < max(-LEAP_S, self._late_s - MAX_AGE_S):
                self.leaps += 1
                self._begin(arrived_s)
            self._least_s -= drift_s
            self._most_s = min(drifted_s, sample_s)
        self._least_s = max(self._least_s, sample_s - link_s)
        self._last_stamp_s = stamp_s
        self._last_arrived_s = arrived_s
        self._late_s = sample_s - self._most_s
        # A message that left the robot late raises the lower bound too far; the upper bound still
        # holds.
        self.delay_s = sample_s - min(self._least_s, self._most_s)
        return stamp_s + self._most_s if self._least_s == -math.inf else arrived_s - self.delay_s

    def _begin(self, arrived_s: float) -> None:
        """Restart learning the clock."""
        self._since_s = arrived_s
        self._least_s = -math.inf
