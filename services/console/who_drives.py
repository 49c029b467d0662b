"""Assignment of the driver: one browser at a time, while it answers in time.

The console sends 20 beats a second, and the browser answers each with its held keys. An answer is
valid for the time when its beat was sent. Answers that a sleeping laptop or a slow link delivers
late therefore do not move the robot, as in the robot's gate for commands.
"""

import hmac
import secrets
from collections.abc import Callable
from typing import Final

from services.robot.clock import PULSE_S, now_s

BEAT_S: Final = PULSE_S  # Beat interval, equal to the operator's pulse.
# Validity of an answer after its beat was sent; then held keys count as released.
LET_GO_S: Final = 5 * BEAT_S
#: Silence after which another browser can take the seat, and after which an unattended robot misses
#: its driver. Requests expire as well, since the seat can change.
LEASE_S: Final = 1.0
# Number of remembered beats; older answers are late anyway.
_KEPT: Final = round(LEASE_S / BEAT_S)


class Seat:
    """The driver's seat, for one thread."""

    def __init__(self, clock: Callable[[], float] = now_s) -> None:
        self.word = ""  # Secret of the current driver, for requests outside the WebSocket.
        self._clock = clock
        self._sitter: object | None = None
        self._heard_s = 0.0
        self._beat = -1
        self._sent_s: dict[int, float] = {}

    def take(self, who: object) -> bool:
        """Take the seat if it is free; return whether it was."""
        now = self._clock()
        if self._sitter is not None and now - self._heard_s <= LEASE_S:
            return False
        self._sitter = who
        self._heard_s = now
        self.word = secrets.token_urlsafe(16)
        self._sent_s.clear()
        return True

    def holds(self, who: object) -> bool:
        """Return whether a browser has the seat."""
        return self._sitter is who

    def knows(self, word: str) -> bool:
        """Return whether a word is the current driver's secret."""
        return self._sitter is not None and hmac.compare_digest(word.encode(), self.word.encode())

    def leave(self, who: object) -> None:
        """Leave the seat."""
        if self._sitter is who:
            self._sitter = None

    def beat(self) -> int:
        """Return the number of the next beat."""
        self._beat += 1
        self._sent_s[self._beat] = self._clock()
        self._sent_s.pop(self._beat - _KEPT, None)
        return self._beat

    def answered(self, beat: int) -> float | None:
        """Return the send time of an answered beat; None if it is unknown or too old."""
        now = self._clock()
        sent_s = self._sent_s.get(beat)
        if sent_s is None:
            return None
        self._heard_s = now
        return sent_s if now < sent_s + LEASE_S else None
