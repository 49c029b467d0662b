"""From the bytes of a terminal to the key that is held.

A terminal tells presses only, never releases. A key that is held repeats; so a key counts as released when its next
repeat is overdue.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Final, Literal

from schemas.base import Atom

#: Keyboards begin to repeat 0.25 to 0.6 s after the press.
FIRST_HOLD_S: Final = 0.6
#: Then they repeat every 0.03 to 0.1 s.
REPEAT_HOLD_S: Final = 0.15

Key = Literal["forward", "backward", "left", "right", "stop", "emergency_stop", "new_episode", "resume", "quit"]
_LETTERS: Final[dict[bytes, Key]] = {
    b"w": "forward",
    b"s": "backward",
    b"a": "left",
    b"d": "right",
    b" ": "stop",
    b"e": "emergency_stop",
    b"n": "new_episode",
    b"r": "resume",
    b"q": "quit",
}
_ARROWS: Final[dict[bytes, Key]] = {b"A": "forward", b"B": "backward", b"D": "left", b"C": "right"}
#: An escape sequence, the beginning of one at the end of the input, or any other byte. No key sends a sequence that
#: ends in e: an emergency stop is heard also after half a one.
_TOKEN: Final = re.compile(rb"\x1b[\[O][0-9;]*([A-Za-df-z~])|(\x1b(?:[\[O][0-9;]*)?\Z)|([\x00-\xff])", re.DOTALL)
_LONGEST_SEQUENCE: Final = 16


class KeyParser:
    """Finds the keys in what a terminal sends; an escape sequence may come in pieces."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, data: bytes) -> Iterator[Key]:
        """Yield the keys in ``data``; unknown ones are passed over."""
        data, self._begun = self._begun + data, b""
        for match in _TOKEN.finditer(data):
            final, begun, single = match.groups()
            if begun is not None and len(begun) < _LONGEST_SEQUENCE:
                self._begun = begun
            key = _ARROWS.get(final) if final else _LETTERS.get((single or b"").lower())
            if key is not None:
                yield key


class KeyHold:
    """Which movement is being asked for.

    Parameters
    ----------
    clock
        Monotonic seconds.
    first_s
        How long the first press counts as held.
    repeat_s
        How long every repeat of the same key counts as held.
    """

    def __init__(
        self, clock: Callable[[], float], first_s: float = FIRST_HOLD_S, repeat_s: float = REPEAT_HOLD_S
    ) -> None:
        self._clock = clock
        self._first_s = first_s
        self._repeat_s = repeat_s
        self._atom: Atom | None = None
        self._until_s = 0.0

    def press(self, atom: Atom) -> None:
        """Take a press, or a repeat if this key is held already; another key takes its place."""
        repeats = self.held() == atom
        self._until_s = self._clock() + (self._repeat_s if repeats else self._first_s)
        self._atom = atom

    def release(self) -> None:
        """Let go."""
        self._atom = None

    def held(self) -> Atom | None:
        """Return the movement whose key is held now."""
        if self._atom is not None and self._clock() >= self._until_s:
            self._atom = None
        return self._atom
