"""Another machine's clock, told by ours."""

from typing import Final

from services.robot.gate import MAX_AGE_S

#: How much the clocks of two computers may drift apart, seconds a second: the least delay seen counts for ever less,
#: but a link that became slow for a minute is not taken for a clock that was set (it makes 12 ms of that).
DRIFT: Final = 200e-6
#: A clock that leaps by more, seconds, was set: a fifth of the age that a frame may have may be wrong, and no more.
LEAP_S: Final = MAX_AGE_S / 5
#: A clock is known after so long, seconds: of what comes in so long something comes without delay. A link that holds
#: all up for longer is dead, and is made anew (`services.ros2.session`).
LEARN_S: Final = 2.0


class StampedClock:
    """Maps the stamps of one stream of messages to when they were made by our clock; the least delay counts as none.

    So what is said is never before the truth, after it by what the fastest message took, and never after the arrival.
    How late a message is cannot be told from how far the other clock was set: after a leap it counts when ``known``
    again.
    """

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._last_stamp_s = 0.0
        self._last_arrived_s = 0.0
        self._since_s = 0.0
        self.leaps = 0  # How many times the other clock seemed to leap.
        self.delay_s = 0.0  # How much longer than the fastest the last message took, seconds.

    @property
    def offset_s(self) -> float | None:
        """Our clock less the other one; None before the first message, and where it was set back."""
        return self._offset_s

    @property
    def known(self) -> bool:
        """Whether it was listened to for long enough since the other clock last seemed to leap."""
        return self._offset_s is not None and self._last_arrived_s - self._since_s >= LEARN_S

    def made_s(self, stamp_s: float, arrived_s: float) -> float | None:
        """Return when a message was made, by our clock; None for one that is not newer than the one before."""
        sample_s = arrived_s - stamp_s
        if self._offset_s is None:
            self._offset_s, self._since_s = sample_s, arrived_s
        elif stamp_s <= self._last_stamp_s:
            if stamp_s < self._last_stamp_s - LEAP_S:
                self.leaps += 1
                self._offset_s = None
            return None
        else:
            drift_s = DRIFT * max(0.0, arrived_s - self._last_arrived_s)
            drifted_s = self._offset_s + drift_s
            # Faster than the fastest; or all at once fast, which may also be a late message with a clock set forward;
            # or heard so long ago that nobody knows.
            if drift_s > LEAP_S or sample_s - drifted_s < max(-LEAP_S, self.delay_s - MAX_AGE_S):
                self.leaps += 1
                self._since_s = arrived_s
            self._offset_s = min(drifted_s, sample_s)
        self._last_stamp_s, self._last_arrived_s = stamp_s, arrived_s
        self.delay_s = sample_s - self._offset_s
        return min(stamp_s + self._offset_s, arrived_s)
