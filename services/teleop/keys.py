"""Parse keys from a terminal's bytes.

Releases follow the kitty protocol, https://sw.kovidgoyal.net/kitty.
"""

import re
from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

#: Control sequences: enable reports of releases (kitty's flags 1, 2 and 8: unambiguous, event types,
#: all keys) and of the focus; disable them; query the support, and its answer.
TELL_RELEASES: Final = "\x1b[>11u\x1b[?1004h"
TELL_NO_RELEASES: Final = "\x1b[?1004l\x1b[<u"
ASK_RELEASES: Final = "\x1b[?u"
RELEASES_ANSWER: Final = re.compile(rb"\x1b\[\?[0-9]+u")

Key = Literal[
    "forward",
    "backward",
    "left",
    "right",
    "stop",
    "emergency_stop",
    "new_episode",
    "resume",
    "found",
    "quit",
]
#: Other reports of a terminal: that it supports releases, and that it has lost the focus.
News = Literal["tells_releases", "focus_lost"]
_LETTERS: Final[dict[str, Key]] = {
    "w": "forward", "s": "backward", "a": "left", "d": "right", " ": "stop", "e": "emergency_stop",
    "n": "new_episode", "r": "resume", "f": "found", "q": "quit",
}  # fmt: skip
_ARROWS: Final[dict[str, Key]] = {"A": "forward", "B": "backward", "D": "left", "C": "right"}
#: With all keys reported, arrows of the number pad have their own codes.
_PAD: Final[dict[int, Key]] = {57419: "forward", 57420: "backward", 57417: "left", 57418: "right"}
_CTRL_C: Final = 3
_KEYS: Final[dict[int, Key]] = {
    **{ord(case): key for letter, key in _LETTERS.items() for case in (letter, letter.upper())},
    **_PAD,
    _CTRL_C: "quit",
}
_EVENT_TYPES: Final = 2  # One of kitty's flags: separate presses, repeats and releases.
# One of kitty's modifiers: all but shift, caps lock and num lock change the meaning of a letter.
_CTRL: Final = 4
_SHORTCUT: Final = ~(1 | 64 | 128)
_RELEASED: Final = "3"
#: An escape sequence, the beginning of one at the end of the input, or any other byte. Sequences end
#: in any letter (End sends ``CSI F``, F2 ``SS3 Q``) except e: an emergency stop also counts after a
#: partial sequence.
_TOKEN: Final = re.compile(
    rb"\x1b[\[O]([<-?]?[0-9;:]*)([A-DF-Za-df-z~])|(\x1b(?:[\[O][<-?]?[0-9;:]*)?\Z)|([\x00-\xff])",
    re.DOTALL,
)
#: ``code : other codes ; modifiers : event ; text``; all parts are optional.
_NUMBERS: Final = re.compile(
    r"([0-9]{0,7})(?::[0-9:]*)?(?:;([0-9]{0,3})(?::([0-9]))?(?:;[0-9:]*)?)?"
)
_FLAGS: Final = re.compile(r"\?([0-9]{1,3})")
_LONGEST_SEQUENCE: Final = 24


class KeyEvent(NamedTuple):
    """Event at the keyboard: a press or repeat, or a release if the terminal reports releases."""

    key: Key | News
    released: bool = False


class KeyParser:
    """Parses a terminal's input, with escape sequences that can arrive in pieces."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, data: bytes) -> Iterator[KeyEvent]:
        """Yield the events of the keys in ``data``; unknown keys are ignored."""
        data = self._begun + data
        self._begun = b""
        for match in _TOKEN.finditer(data):
            numbers, final, begun, single = match.groups()
            if begun is not None and len(begun) < _LONGEST_SEQUENCE:
                self._begun = begun
            if final:
                event = _event(numbers.decode(), final.decode())
            else:
                key = _KEYS.get(single[0]) if single else None
                event = None if key is None else KeyEvent(key)
            if event is not None:
                yield event


def _event(numbers: str, final: str) -> KeyEvent | None:
    """Parse ``CSI ? flags u``, ``CSI O`` or ``CSI code ; modifiers : event`` with u or A to D."""
    flags = _FLAGS.fullmatch(numbers)
    if flags is not None:
        return KeyEvent("tells_releases") if final == "u" and int(flags[1]) & _EVENT_TYPES else None
    if final == "O" and not numbers:
        return KeyEvent("focus_lost")
    match = _NUMBERS.fullmatch(numbers)
    if match is None:
        return None
    code, modifiers, event = match.groups()
    if final != "u":
        key = _ARROWS.get(final)
        return None if key is None else KeyEvent(key, event == _RELEASED)
    return _letter(int(code or 0), max(int(modifiers or 1) - 1, 0), event == _RELEASED)


def _letter(code: int, modifiers: int, released: bool) -> KeyEvent | None:
    key = _KEYS.get(code)
    # Releases and stops count with any modifiers.
    if modifiers & _SHORTCUT and not released and key not in ("stop", "emergency_stop"):
        # Such a terminal sends Ctrl-C as a key.
        key = "quit" if modifiers & _CTRL and code in (ord("c"), ord("C")) else None
    return None if key is None else KeyEvent(key, released)
