"""Times of capture, from the clocks of a recording: a clock is trusted as far as others agree.

A file holds messages in the order of reception. Headers hold the time of capture by the clock of
the sender. Both clocks can be set during a drive; then their times pass twice over the same span.
Messages that arrive late, in contrast, fill a hole in the times before them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.importers.drive import Array, Tally

#: Samples in order that show a step of the clock. Networks rarely deliver as many late in order.
_RUN: Final = 5
_MOST_STEPS: Final = 100  # A clock that steps more often is no clock.
#: Longest delay of a network. Stamps that are older are of another clock.
_LONGEST_DELAY_S: Final = 60.0
_SHORTEST: Final = 0.01  # Quantile of the delays that is the shortest, without outliers.
#: Units of times that are not seconds, and periods of cameras that show them.
_UNITS: Final = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
_FASTEST_S: Final = 1.0 / 60.0
_SLOWEST_S: Final = 1.0
_NOTABLE_S: Final = 0.1  # Smallest offset of clocks that changes which frame a tick shows.


@dataclass
class Times:
    """Times of the messages of a topic, in the order of the file."""

    topic: str
    numbers: NDArray[np.int64]  # Position of each message in the file.
    received_s: Array
    stamps_s: Array  # 0 if the clock was not set, NaN if the type has no header.
    large: bool = False  # Whether a network delays the messages, such as images.

    def shift(self, number: int, by_s: float) -> None:
        """Move the times from a message on, those of capture if their clock stepped with it."""
        at = int(np.searchsorted(self.numbers, number))
        self.received_s[at:] += by_s
        if 0 < at < self.numbers.size and self.stamps_s[at] < self.stamps_s[at - 1]:
            self.stamps_s[at:] += by_s

    def rejoin(self, tally: Tally) -> None:
        """Undo steps of the clock of the sender that the reception does not show."""
        known = np.flatnonzero(self.stamps_s > 0.0)
        stamps_s = self.stamps_s[known]
        received_s = self.received_s[known]
        found: list[str] = []
        for at in _steps(stamps_s, received_s):
            by_s = np.diff(received_s)[at - 1] - np.diff(stamps_s)[at - 1]
            stamps_s[at:] += by_s
            found.append(
                f"by {-by_s:.1f} s, {stamps_s[at] - stamps_s[0]:.1f} s after the first message"
            )
        tally.say_all(f"{self.topic}: rejoined, as its clock steps", found)
        self.stamps_s[known] = stamps_s

    @property
    def delay_s(self) -> float:
        """Shortest delay from capture to reception, by two clocks; NaN without stamps."""
        known = self.stamps_s > 0.0
        delays_s = (self.received_s - self.stamps_s)[known]
        return float(np.quantile(delays_s, _SHORTEST)) if delays_s.size else math.nan

    def captured_s(self, offset_s: float, tally: Tally) -> Array:
        """Return the times of capture, NaN for messages without one.

        The clock of the recorder is ahead of the others by an offset.
        """
        stamped = not np.isnan(self.stamps_s).all()
        delay_s = self.delay_s - offset_s
        if np.isnan(delay_s):
            if stamped:
                tally.say(
                    f"{self.topic}: no time of capture in the headers; the time of reception is "
                    "used"
                )
            known = self.received_s > 0.0
            times_s = self.received_s - offset_s
        else:
            known = self.stamps_s > 0.0
            aligned = -_NOTABLE_S <= delay_s <= _LONGEST_DELAY_S
            times_s = self.stamps_s + (0.0 if aligned else delay_s)
            if not aligned:
                tally.say(f"{self.topic}: its clock differs by {delay_s:.1f} s; aligned")
        tally.count(
            f"messages of {self.topic} have no time (sent before the clock)", int((~known).sum())
        )
        late = int((np.diff(times_s[known]) < 0.0).sum())
        if late:
            tally.say(
                f"{self.topic}: {late} messages out of order, sorted by their time of capture"
            )
        return np.where(known, times_s, np.nan)


def captured(streams: list[Times], tally: Tally) -> list[Array]:
    """Return the times of capture of the messages of topics, on one clock."""
    rejoin(streams, tally)
    for stream in streams:
        stream.rejoin(tally)
    # A delay of small messages is an offset of the recorder's clock.
    delays_s = [one.delay_s for one in streams if not one.large and not np.isnan(one.delay_s)]
    offset_s = min(delays_s, key=abs, default=0.0)
    return [stream.captured_s(offset_s, tally) for stream in streams]


def rejoin(streams: list[Times], tally: Tally) -> None:
    """Undo steps of the recorder's clock, in all streams at the same message."""
    steps: list[str] = []
    for _ in range(_MOST_STEPS):
        found = [
            (stream.numbers[at], stream, at)
            for stream in streams
            if (at := _set_back(stream.received_s))
        ]
        if not found:
            break
        number, first, at = min(found, key=lambda step: int(step[0]))
        times_s = first.received_s
        before_s = [
            stream.received_s[last - 1]
            for stream in streams
            if (last := int(np.searchsorted(stream.numbers, number)))
        ]
        due_s = max(*before_s, times_s[at - 1] + float(np.median(np.diff(times_s[:at]))))
        by_s = due_s - times_s[at]
        for stream in streams:
            stream.shift(number, by_s)
        begin_s = min(stream.received_s[0] for stream in streams)
        steps.append(f"by {by_s:.1f} s, {due_s - begin_s:.1f} s after the first message")
    tally.say_all("rejoined: the clock is set back", steps)


def in_order(times_s: Array, tally: Tally) -> Array:
    """Return times without steps back of the clock; late rows keep their time."""
    times = Times("times", np.arange(times_s.size), times_s.copy(), np.full(times_s.size, np.nan))
    rejoin([times], tally)
    return times.received_s


def seconds_of(times_s: Array, tally: Tally) -> Array:
    """Return the times of frames in seconds, from the unit in which they are those of a camera."""
    later = np.diff(times_s)
    usual = float(np.median(later[later > 0.0])) if (later > 0.0).any() else 0.0
    for unit, name in _UNITS.items():
        if _FASTEST_S <= usual / unit <= _SLOWEST_S:
            tally.say(f"times are in {name} (a frame each {usual:.0f}); converted to seconds")
            return times_s / unit
    return times_s


def _steps(stamps_s: Array, received_s: Array) -> Iterator[int]:
    """Yield where a sender's clock steps; the caller undoes each step before the next."""
    for _ in range(_MOST_STEPS):
        at = _set_back(stamps_s) or _set_ahead(stamps_s, received_s)
        if not at:
            return
        yield at


def _set_back(times_s: Array) -> int:
    """Return the first sample after a step back of the clock, 0 without a step."""
    if times_s.size <= _RUN:
        return 0
    later = np.diff(times_s) > 0.0
    ordered = np.lib.stride_tricks.sliding_window_view(later, _RUN)[:, 1:].all(axis=1)
    reached_s = np.maximum.accumulate(times_s)
    for at in (np.flatnonzero(~later[: ordered.size] & ordered) + 1).tolist():
        run_s = times_s[at : at + _RUN]
        passed = np.searchsorted(reached_s[:at], run_s[[0, -1]], side="right")
        if run_s[0] < times_s[:at].min() or 2 * np.diff(passed)[0] >= _RUN:
            return int(at)
    return 0


def _set_ahead(stamps_s: Array, received_s: Array) -> int:
    """Return the first sample after a step ahead that the reception does not show, 0 without."""
    by_s = np.diff(stamps_s) - np.diff(received_s)
    delays_s = received_s - stamps_s
    for at in (np.flatnonzero(by_s > 1.0) + 1).tolist():
        # A late message before the step also makes the difference; its stamps are sound.
        if delays_s[at : at + _RUN].max() < delays_s[:at].min() - by_s[at - 1] / 2.0:
            return int(at)
    return 0
