"""From bytes to keys."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.teleop.keys import KeyParser


def keys_of(data: bytes, parser: KeyParser | None = None) -> list[str]:
    """Return the keys that are pressed, and, with a minus, those that are let go."""
    return [
        f"-{event.key}" if event.released else event.key
        for event in (parser or KeyParser()).feed(data)
    ]


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"wsad", ["forward", "backward", "left", "right"]),
        (b"WSAD", ["forward", "backward", "left", "right"]),
        (b"\x1b[A\x1b[B\x1b[D\x1b[C", ["forward", "backward", "left", "right"]),
        (b"\x1bOA\x1bOB\x1bOD\x1bOC", ["forward", "backward", "left", "right"]),
        (b"\x1b[1;5A", ["forward"]),
        (b" enrfq", ["stop", "emergency_stop", "new_episode", "resume", "found", "quit"]),
        (b"\x03", ["quit"]),
        (b"\x1b[3~\x1b[Hxyz\xff\x00\x1b[Z", []),
        (b"\x1be", ["emergency_stop"]),
        ("é€w".encode(), ["forward"]),
    ],
)
def test_keys_of_bytes(data: bytes, keys: list[str]) -> None:
    assert keys_of(data) == keys


def test_the_letters_of_an_escape_sequence_are_no_keys() -> None:
    """End sends F, and F2 to F4 send Q, R and S; f, q, r and s are keys."""
    for begun in (b"\x1b[1;2", b"\x1bO", b"\x1b["):
        for final in b"FGHIJKLMNPQRSTUVWXYZabcdfghijklmnopqrstuvwxyz":
            assert keys_of(begun + bytes([final])) == []


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (b"\x1b[119u\x1b[119;1:2u\x1b[119;1:3u", ["forward", "forward", "-forward"]),
        (b"\x1b[119;1:1u", ["forward"]),
        (b"\x1b[119:87;2;87u", ["forward"]),
        (b"\x1b[119;65u\x1b[119;129u\x1b[119;194:3u", ["forward", "forward", "-forward"]),
        (b"\x1b[87;2u", ["forward"]),
        (b"\x1b[A\x1b[1;1:2A\x1b[1;129:3A", ["forward", "forward", "-forward"]),
        (b"\x1b[57417;129u\x1b[57417;129:3u", ["left", "-left"]),
        (b"\x1b[99;5u", ["quit"]),
        (b"\x1b[99;197u", ["quit"]),
        (b"\x1b[99;5:3u\x1b[99u", ["-quit"]),
        (b"\x1b[119;5u\x1b[100;9u\x1b[113;3u\x1b[110;5u", []),
        (b"\x1b[119;5:3u", ["-forward"]),
        (b"\x1b[101u\x1b[101;5u\x1b[32;9u", ["emergency_stop", "emergency_stop", "stop"]),
        (b"\x1b[57441;2u\x1b[57442;5:3u\x1b[13u\x1b[27u\x1b[u\x1b[;:u", []),
        (b"\x1b[?11u", ["tells_releases"]),
        (b"\x1b[?0u\x1b[?1u\x1b[?u\x1b[?62c", []),
        (b"\x1b[I\x1b[O", ["focus_lost"]),
    ],
)
def test_keys_of_the_kitty_protocol(data: bytes, keys: list[str]) -> None:
    keys = [key for key in keys if key != "-quit"]
    assert [key for key in keys_of(data) if key != "-quit"] == keys


SEQUENCES = [
    b"w", b"\x1b[A", b"\x1bOC", b"e", b"x", b"\x1b[1;2B",
    b"\x1b[119u", b"\x1b[119;1:3u", b"\x1b[101;129:2u", b"\x1b[1;1:3D", b"\x1b[O", b"\x1b[?11u", b"\x1b[F",
]  # fmt: skip
#: Bytes that mean something stand beside any others.
meaningful = st.one_of(
    st.binary(max_size=20),
    st.sampled_from(SEQUENCES),
    st.text("\x1b[O0123456789;:?<>ueEA~", max_size=40).map(str.encode),
)


@given(st.lists(st.sampled_from(SEQUENCES), max_size=10), st.data())
def test_it_does_not_matter_how_the_bytes_come_in_pieces(
    parts: list[bytes], data: st.DataObject
) -> None:
    whole = b"".join(parts)
    parser = KeyParser()
    keys = []
    rest = whole
    while rest:
        size = data.draw(st.integers(1, len(rest)))
        keys += parser.feed(rest[:size])
        rest = rest[size:]
    assert keys == list(KeyParser().feed(whole))


@pytest.mark.parametrize("stop", [b"e", b"E", b"\x1b[101u", b"\x1b[101;1:1u", b"\x1b[101;66:2u"])
@given(pieces=st.lists(meaningful, max_size=20))
def test_emergency_stop_is_parsed_after_any_bytes(stop: bytes, pieces: list[bytes]) -> None:
    parser = KeyParser()
    for piece in pieces:
        list(parser.feed(piece))
    assert keys_of(stop, parser)[-1:] == ["emergency_stop"]
