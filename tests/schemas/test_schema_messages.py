"""Every message: the bytes on the wire, round trips, and everything that must be refused."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.codec import decode, encode, encoding_of
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from schemas.observation import Observation
from schemas.state import MAX_PLACES, State
from tests.places import places
from tests.schemas import messages
from tests.schemas.messages import CLASSES, EXAMPLES, any_message

GOLDEN = json.loads(messages.GOLDEN.read_text())


def name_of(cls: type[Message]) -> str:
    return cls.__name__


@pytest.mark.parametrize("cls", CLASSES, ids=name_of)
def test_the_wire_does_not_change(cls: type[Message]) -> None:
    """A change here breaks recordings and running robots: raise the message's version, then renew golden.json."""
    golden = GOLDEN[cls.__name__]
    assert messages.golden_of(cls) == golden
    assert decode(cls, bytes.fromhex(golden["hex"]), golden["encoding"]) == EXAMPLES[cls]


@given(any_message)
def test_round_trip(message: Message) -> None:
    payload = encode(message)
    decoded = decode(type(message), payload, encoding_of(type(message)))
    assert decoded == message
    assert encode(decoded) == payload


@pytest.mark.parametrize("cls", CLASSES, ids=name_of)
def test_every_field_and_message_is_documented(cls: type[Message]) -> None:
    schema = cls.model_json_schema()
    assert schema["description"]
    assert [
        name for name, field in schema["properties"].items() if not field.get("description")
    ] == []


def altered(cls: type[Message], **fields: object) -> Message:
    return cls.model_validate(EXAMPLES[cls].model_dump() | fields)


#: What no message may have in its header.
WRONG: list[dict[str, object]] = [
    {"colour": "red"}, {"tick": -1}, {"tick": 10_000_001}, {"tick": 1.0}, {"stamp_ns": -1}, {"stamp_ns": 2**63},
    {"episode": "../x"},
    *({"robot": robot} for robot in ("", "Rescuebot", "a/b", "a*", "-a", "a" * 33, "a\n", "ä", 5, b"a")),
]  # fmt: skip
NO_NUMBERS = (math.nan, math.inf, -math.inf, -1e300, "1", True, None, b"1", (1,), 10**30)


@pytest.mark.parametrize("cls", CLASSES, ids=name_of)
def test_fields_that_lack_or_are_wrong_or_unknown_are_refused(cls: type[Message]) -> None:
    for name, field in cls.model_fields.items():
        if field.is_required():
            fields = EXAMPLES[cls].model_dump()
            del fields[name]
            with pytest.raises(ValidationError, match="Field required"):
                cls.model_validate(fields)
        for wrong in NO_NUMBERS if field.annotation in (int, float) else ():
            with pytest.raises(ValidationError):
                altered(cls, **{name: wrong})
    for header in WRONG:
        with pytest.raises(ValidationError):
            altered(cls, **header)


@pytest.mark.parametrize(
    ("cls", "fields"),
    [
        (CompressedImage, {"width": 0}),
        (CompressedImage, {"width": 4097}),
        (CompressedImage, {"data": "123456"}),
        (CompressedImage, {"data": b""}),
        (Observation, {"features": {"dtype": "float32", "shape": (2,), "data": bytes(4)}}),
        (Observation, {"features": {"dtype": "float64", "shape": (1,), "data": bytes(4)}}),
        (Observation, {"features": {"dtype": "float32", "shape": (), "data": bytes(4)}}),
        (Observation, {"features": {"dtype": "float32", "shape": (-1,), "data": b""}}),
        (
            Observation,
            {"features": {"dtype": "float32", "shape": (1,), "data": bytes.fromhex("0000c07f")}},
        ),
        (
            Observation,
            {"features": {"dtype": "float32", "shape": (1,), "data": bytes.fromhex("0000807f")}},
        ),
        (Observation, {"fingerprint": "xyz"}),
        (State, {"status": "unknown", "state": 7}),
        (State, {"state": 7}),
        (State, {"places": places()}),
        (State, {"model": None}),
        (State, {"model": "ABCDEF01"}),
        (State, {"status": "idle"}),
        (State, {"score": -0.1}),
        (State, {"lost": 1.1}),
        (State, {"places": Float32Array.from_numpy(np.zeros(5, np.float32))}),
        (State, {"places": Float32Array.from_numpy(np.zeros((1, 4), np.float32))}),
        (State, {"places": places((0.5, 0.0, 0.0, 0.0, 1.0))}),
        (State, {"places": places((-1.0, 0.0, 0.0, 0.0, 1.0))}),
        (State, {"places": places((1.0, 0.0, 0.0, 3.3, 1.0))}),
        (State, {"places": places(*[(1.0, 0.0, 0.0, 0.0, 0.6)] * 2)}),
        (State, {"places": places(*[(1.0, 0.0, 0.0, 0.0, 0.0)] * (MAX_PLACES + 1))}),
        (Episode, {"outcome": None}),
        (Episode, {"event": "started"}),
        (Episode, {"world": ""}),
        (CommandApplied, {"answered_tick": -1}),
        (CommandApplied, {"answered_tick": 10_000_001}),
    ],
    ids=str,
)
def test_contradictions_are_refused(cls: type[Message], fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        altered(cls, **fields)


@given(st.sampled_from(CLASSES), st.data())
def test_words_outside_a_choice_are_refused(cls: type[Message], data: st.DataObject) -> None:
    choices = [
        n
        for n in ("atom", "source", "reason", "kind", "status", "event", "purpose", "driver")
        if n in cls.model_fields
    ]
    if choices:
        name = data.draw(st.sampled_from(choices))
        word = "?" + data.draw(st.text(max_size=5))
        with pytest.raises(ValidationError):
            altered(cls, **{name: word})


@pytest.mark.parametrize(
    "wrong", [{"atom": "up"}, {"speed": 2.0}, {"speed": "fast"}, {"speed": math.nan}], ids=str
)
def test_command_is_a_velocity_when_a_key_is_given(wrong: dict[str, object]) -> None:
    fields = EXAMPLES[Command].model_dump(exclude={"linear", "angular"}) | {
        "atom": "left",
        "speed": 0.5,
    }
    assert Command.model_validate(fields).velocity == (0.0, 0.5)
    with pytest.raises(ValidationError):
        Command.model_validate(fields | wrong)
