"""Who drives: one browser at a time, and only while it answers in time.

The console sends a beat 20 times a second, and the browser answers each with what is held. An answer says something
of the moment when its beat was sent, and of no later one: what a sleeping laptop or a slow link delivers late moves
nothing, as the robot's gate has it for commands.
"""

import hmac
import secrets
from collections.abc import Callable
from typing import Final

from services.robot.clock import PULSE_S, now_s

BEAT_S: Final = PULSE_S  # How often a browser has to answer: as often as the operator of a robot.
LET_GO_S: Final = 0.25  # Time after its beat was sent when an answer counts no more, and when what was held is let go.
#: Silence after which somebody else may take the seat, and a robot that would move alone misses who had it. What is
#: asked for counts as long: later it may be somebody else's turn.
LEASE_S: Final = 1.0
_KEPT: Final = round(
    LEASE_S / BEAT_S
)  # Beats in flight that are remembered; an answer to an older one is late anyway.


class Seat:
    """The one place from which the robot is driven; of one thread."""

    def __init__(self, clock: Callable[[], float] = now_s) -> None:
        self.word = ""  # What only who has the seat is told, to show with what comes another way.
        self._clock = clock
        self._sitter: object | None = None
        self._heard_s = 0.0
        self._beat = -1
        self._sent_s: dict[int, float] = {}

    def take(self, who: object) -> bool:
        """Sit down, unless somebody else is there."""
        now = self._clock()
        if self._sitter is not None and now - self._heard_s <= LEASE_S:
            return False
        self._sitter = who
        self._heard_s = now
        self.word = secrets.token_urlsafe(16)
        self._sent_s.clear()
        return True

    def holds(self, who: object) -> bool:
        """Whether this one has the seat."""
        return self._sitter is who

    def knows(self, word: str) -> bool:
        """Whether a word is that of whoever has the seat now."""
        return self._sitter is not None and hmac.compare_digest(word.encode(), self.word.encode())

    def leave(self, who: object) -> None:
        """Stand up."""
        if self._sitter is who:
            self._sitter = None

    def beat(self) -> int:
        """Return the number of the beat that is sent now."""
        self._beat += 1
        self._sent_s[self._beat] = self._clock()
        self._sent_s.pop(self._beat - _KEPT, None)
        return self._beat

    def answered(self, beat: int) -> float | None:
        """Return when a beat was sent that is answered now; None where it is too old, or there was no such beat."""
        now = self._clock()
        sent_s = self._sent_s.get(beat)
        if sent_s is None:
            return None
        self._heard_s = now
        return sent_s if now < sent_s + LEASE_S else None
