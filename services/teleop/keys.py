"""From the bytes of a terminal to keys; releases by the kitty protocol, https://sw.kovidgoyal.net/kitty."""

import re
from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

#: What has a terminal tell releases (kitty's flags 1, 2 and 8: unambiguous, event types, all keys) and the loss of its
#: focus; what takes that back; what asks whether it does, and the answer.
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
#: What a terminal tells besides: that it tells releases, and that its keys go to another window now.
News = Literal["tells_releases", "focus_lost"]
_LETTERS: Final[dict[str, Key]] = {
    "w": "forward", "s": "backward", "a": "left", "d": "right", " ": "stop", "e": "emergency_stop",
    "n": "new_episode", "r": "resume", "f": "found", "q": "quit",
}  # fmt: skip
_ARROWS: Final[dict[str, Key]] = {"A": "forward", "B": "backward", "D": "left", "C": "right"}
#: Arrows of the number pad have numbers of their own where all keys are told.
_PAD: Final[dict[int, Key]] = {57419: "forward", 57420: "backward", 57417: "left", 57418: "right"}
_CTRL_C: Final = 3
_KEYS: Final[dict[int, Key]] = {
    **{ord(case): key for letter, key in _LETTERS.items() for case in (letter, letter.upper())},
    **_PAD,
    _CTRL_C: "quit",
}
_EVENT_TYPES: Final = 2  # Of kitty's flags: whether presses, repeats and releases are told apart.
_CTRL: Final = (
    4  # Of kitty's modifiers: all but shift, caps lock and num lock make another key of a letter.
)
_SHORTCUT: Final = ~(1 | 64 | 128)
_RELEASED: Final = "3"
#: An escape sequence, the beginning of one at the end of the input, or any other byte. Sequences end in any letter (End
#: sends ``CSI F``, F2 ``SS3 Q``), but for e: an emergency stop is heard also after half a one.
_TOKEN: Final = re.compile(
    rb"\x1b[\[O]([<-?]?[0-9;:]*)([A-DF-Za-df-z~])|(\x1b(?:[\[O][<-?]?[0-9;:]*)?\Z)|([\x00-\xff])",
    re.DOTALL,
)
#: ``code : other codes ; modifiers : event ; text``; all may be left out.
_NUMBERS: Final = re.compile(
    r"([0-9]{0,7})(?::[0-9:]*)?(?:;([0-9]{0,3})(?::([0-9]))?(?:;[0-9:]*)?)?"
)
_FLAGS: Final = re.compile(r"\?([0-9]{1,3})")
_LONGEST_SEQUENCE: Final = 24


class KeyEvent(NamedTuple):
    """What happened at the keyboard: a press or a repeat, or a release where the terminal tells it."""

    key: Key | News
    released: bool = False


class KeyParser:
    """Finds the keys in what a terminal sends; an escape sequence may come in pieces."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, data: bytes) -> Iterator[KeyEvent]:
        """Yield what happened to the keys in ``data``; unknown ones are passed over."""
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
    """Read ``CSI ? flags u``, ``CSI O``, ``CSI code ; modifiers : event u`` or ``CSI 1 ; modifiers : event ABCD``."""
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
    # A release counts whatever is held down by then, and so does whatever makes the robot stand.
    if modifiers & _SHORTCUT and not released and key not in ("stop", "emergency_stop"):
        # Such a terminal sends Ctrl-C as a key.
        key = "quit" if modifiers & _CTRL and code in (ord("c"), ord("C")) else None
    return None if key is None else KeyEvent(key, released)
