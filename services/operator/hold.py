"""The key that is held.

Most terminals do not tell when a key is let go; in them a key that is held repeats. So a key counts as released when
its next repeat is overdue.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from schemas.base import Atom

#: Keyboards begin to repeat 0.25 to 0.6 s after the press.
FIRST_HOLD_S: Final = 0.6
#: Then they repeat every 0.03 to 0.1 s.
REPEAT_HOLD_S: Final = 0.15


class KeyHold:
    """Which movement is being asked for.

    Parameters
    ----------
    clock
        Seconds.
    first_s, repeat_s
        How long the first press counts as held, and every repeat of the same key.
    """

    def __init__(
        self, clock: Callable[[], float], first_s: float = FIRST_HOLD_S, repeat_s: float = REPEAT_HOLD_S
    ) -> None:
        self._clock = clock
        self._first_s = first_s
        self._repeat_s = repeat_s
        self._atom: Atom | None = None
        self._until_s = 0.0

    def press(self, atom: Atom, until_s: float | None = None) -> None:
        """Take a press or a repeat; another key takes the place of the one before.

        ``until_s`` says until when it counts as held, where that is known better.
        """
        usual_s = self._clock() + (self._repeat_s if self.held() == atom else self._first_s)
        self._until_s = usual_s if until_s is None else until_s
        self._atom = atom

    def release(self, atom: Atom | None = None) -> None:
        """Let go of a key, if that is the one that is held; of every key without one."""
        if atom in (None, self._atom):
            self._atom = None

    def held(self) -> Atom | None:
        """Return the movement whose key is held now."""
        if self._atom is not None and self._clock() >= self._until_s:
            self._atom = None
        return self._atom
