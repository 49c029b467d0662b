"""From bytes to keys, and from presses to what is held."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import ATOMS
from services.teleop.keys import FIRST_HOLD_S, REPEAT_HOLD_S, Key, KeyHold, KeyParser

atoms = st.sampled_from(ATOMS)
pauses = st.floats(0, 2)


class Clock:
    """A clock that tests turn."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wsad", ["forward", "backward", "left", "right"]),
        (b"WSAD", ["forward", "backward", "left", "right"]),
        (b"\x1b[A\x1b[B\x1b[D\x1b[C", ["forward", "backward", "left", "right"]),
        (b"\x1bOA\x1bOB\x1bOD\x1bOC", ["forward", "backward", "left", "right"]),
        (b"\x1b[1;5A", ["forward"]),
        (b" enq", ["stop", "emergency_stop", "new_episode", "quit"]),
        (b"\x1b[3~\x1b[Hxyz\xff\x00\x1b[Z", []),
        (b"\x1be", ["emergency_stop"]),
        ("é€w".encode(), ["forward"]),
    ],
)
def test_keys_of_bytes(data: bytes, keys: list[Key]) -> None:
    assert list(KeyParser().feed(data)) == keys


def test_the_letters_of_an_escape_sequence_are_no_keys() -> None:
    """Arrow left ends in D, and D alone is a key."""
    assert list(KeyParser().feed(b"\x1b[D")) == ["left"]


@given(st.lists(st.sampled_from([b"w", b"\x1b[A", b"\x1bOC", b"e", b"x", b"\x1b[1;2B"]), max_size=10), st.data())
def test_it_does_not_matter_how_the_bytes_come_in_pieces(parts: list[bytes], data: st.DataObject) -> None:
    whole = b"".join(parts)
    parser, keys, rest = KeyParser(), [], whole
    while rest:
        size = data.draw(st.integers(1, len(rest)))
        keys += parser.feed(rest[:size])
        rest = rest[size:]
    assert keys == list(KeyParser().feed(whole))


@given(st.lists(st.binary(max_size=20), max_size=20))
def test_any_bytes_are_taken_and_an_emergency_stop_is_heard_after_them(pieces: list[bytes]) -> None:
    parser = KeyParser()
    for piece in pieces:
        list(parser.feed(piece))
    # One byte more may still be part of a sequence that was begun.
    assert "emergency_stop" in list(parser.feed(b"ee"))


def test_a_press_is_held_until_the_keyboard_would_have_repeated_it() -> None:
    clock = Clock()
    hold = KeyHold(clock)
    hold.press("forward")
    clock.now_s = FIRST_HOLD_S - 0.01
    assert hold.held() == "forward"
    clock.now_s = FIRST_HOLD_S
    assert hold.held() is None


def test_a_key_that_repeats_is_held_and_released_soon_after_the_last_repeat() -> None:
    clock = Clock()
    hold = KeyHold(clock)
    hold.press("left")
    clock.now_s = 0.5
    for _ in range(20):
        hold.press("left")
        assert hold.held() == "left"
        clock.now_s += 0.04
    clock.now_s += REPEAT_HOLD_S - 0.04 - 0.001
    assert hold.held() == "left"
    clock.now_s += 0.002
    assert hold.held() is None


def test_another_key_takes_over_with_a_first_hold_of_its_own() -> None:
    clock = Clock()
    hold = KeyHold(clock)
    hold.press("left")
    clock.now_s = 0.1
    hold.press("forward")
    clock.now_s = 0.1 + FIRST_HOLD_S - 0.01
    assert hold.held() == "forward"


def test_letting_go() -> None:
    hold = KeyHold(Clock())
    hold.press("forward")
    hold.release()
    assert hold.held() is None


@given(st.lists(st.tuples(pauses, atoms), max_size=30), pauses)
def test_what_is_held_is_the_last_key_and_never_for_long(presses: list[tuple[float, str]], pause_s: float) -> None:
    clock = Clock()
    hold = KeyHold(clock)
    for wait_s, atom in presses:
        clock.now_s += wait_s
        hold.press(atom)
        assert hold.held() == atom
    clock.now_s += pause_s
    if not presses or pause_s >= FIRST_HOLD_S:
        assert hold.held() is None
    elif pause_s < REPEAT_HOLD_S / 2:
        assert hold.held() == presses[-1][1]


@given(st.lists(st.floats(0.01, REPEAT_HOLD_S - 0.01), max_size=30))
def test_a_held_key_is_never_interrupted(intervals_s: list[float]) -> None:
    clock = Clock()
    hold = KeyHold(clock)
    hold.press("forward")
    clock.now_s = FIRST_HOLD_S - 0.01
    for interval_s in intervals_s:
        assert hold.held() == "forward"
        hold.press("forward")
        clock.now_s += interval_s
    assert hold.held() == "forward"


@pytest.mark.parametrize("begun", [b"\x1b", b"\x1b[", b"\x1bO", b"\x1b[12;"])
def test_an_emergency_stop_is_heard_after_half_an_escape_sequence(begun: bytes) -> None:
    parser = KeyParser()
    assert not list(parser.feed(begun))
    assert list(parser.feed(b"e"))[-1:] == ["emergency_stop"]
