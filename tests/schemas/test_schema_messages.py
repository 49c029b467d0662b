"""Every message: its bytes on the wire, round trips, and the fields that it refuses."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import CameraInfo, CompressedImage
from schemas.codec import decode, describe, encode, encoding_of
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
def test_wire_format_does_not_change(cls: type[Message]) -> None:
    """A change breaks recordings and running robots.

    Raise the message's version, then renew golden.json.
    """
    golden = GOLDEN[cls.__name__]
    assert messages.golden_of(cls) == golden
    assert decode(cls, bytes.fromhex(golden["hex"]), golden["encoding"]) == EXAMPLES[cls]


@given(any_message())
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


def check_refused(cls: type[Message], words: str, fields: dict[str, object]) -> None:
    """Check that a class refuses fields, and that the reason has these words."""
    with pytest.raises(ValidationError) as refused:
        cls.model_validate(fields)
    assert words in describe(refused.value)


#: Fields that no message may have in its header.
WRONG: list[dict[str, object]] = [
    {"colour": "red"}, {"tick": -1}, {"tick": 10_000_001}, {"tick": 1.0}, {"stamp_ns": -1}, {"stamp_ns": 2**63},
    {"episode": "../x"},
    *({"robot": robot} for robot in ("", "Rescuebot", "a/b", "a*", "-a", "a" * 33, "a\n", "ä", 5, b"a")),
]  # fmt: skip
NO_NUMBERS = (math.nan, math.inf, -math.inf, -1e300, "1", True, None, b"1", (1,), 10**30)


@pytest.mark.parametrize("cls", CLASSES, ids=name_of)
def test_message_is_refused_when_a_field_is_missing_or_invalid(cls: type[Message]) -> None:
    example = EXAMPLES[cls].model_dump()
    for name, field in cls.model_fields.items():
        if field.is_required():
            lacking = {other: value for other, value in example.items() if other != name}
            check_refused(cls, f"{name}: Field required", lacking)
        for wrong in NO_NUMBERS if field.annotation in (int, float) else ():
            check_refused(cls, f"{name}: ", example | {name: wrong})
    for header in WRONG:
        check_refused(cls, f"{next(iter(header))}: ", example | header)


def features(shape: tuple[int, ...], data: str = "00000000", dtype: str = "float32") -> object:
    return {"dtype": dtype, "shape": shape, "data": bytes.fromhex(data)}


@pytest.mark.parametrize(
    ("cls", "words", "fields"),
    [
        (CompressedImage, "width: ", {"width": 0}),
        (CompressedImage, "width: ", {"width": 4097}),
        (CompressedImage, "data: ", {"data": "123456"}),
        (CompressedImage, "data: ", {"data": b""}),
        (CameraInfo, "invalid focal_px", {"focal_px": 10.0}),
        (CameraInfo, "invalid focal_px", {"focal_px": 9e3}),
        (CameraInfo, "must meet the image", {"centre_x_px": 3000.0}),
        (Observation, "do not fill float32", {"features": features((2,))}),
        (Observation, "features.dtype: ", {"features": features((1,), dtype="float64")}),
        (Observation, "features.shape: ", {"features": features(())}),
        (Observation, "features.shape.0: ", {"features": features((-1,), "")}),
        (Observation, "NaN or infinity", {"features": features((1,), "0000c07f")}),
        (Observation, "NaN or infinity", {"features": features((1,), "0000807f")}),
        (Observation, "fingerprint: ", {"fingerprint": "xyz"}),
        (State, "a state is given exactly", {"status": "unknown", "state": 7}),
        (State, "a state is given exactly", {"state": 7}),
        (State, "a state is given exactly", {"places": places()}),
        (State, "the model is given exactly", {"model": None}),
        (State, "model: ", {"model": "ABCDEF01"}),
        (State, "the model is given exactly", {"status": "idle"}),
        (State, "score: ", {"score": -0.1}),
        (State, "lost: ", {"lost": 1.1}),
        (State, "must be (n, 5)", {"places": Float32Array.from_numpy(np.zeros(5, np.float32))}),
        (
            State,
            "must be (n, 5)",
            {"places": Float32Array.from_numpy(np.zeros((1, 4), np.float32))},
        ),
        (State, "out of range", {"places": places((0.5, 0.0, 0.0, 0.0, 1.0))}),
        (State, "out of range", {"places": places((-1.0, 0.0, 0.0, 0.0, 1.0))}),
        (State, "out of range", {"places": places((1.0, 0.0, 0.0, 3.3, 1.0))}),
        (State, "the weights of places", {"places": places(*[(1.0, 0.0, 0.0, 0.0, 0.6)] * 2)}),
        (State, "at most 100", {"places": places(*[(1.0, 0.0, 0.0, 0.0, 0.0)] * (MAX_PLACES + 1))}),
        (Episode, "outcome is given exactly", {"outcome": None}),
        (Episode, "outcome is given exactly", {"event": "started"}),
        (Episode, "world: ", {"world": ""}),
        (CommandApplied, "answered_tick: ", {"answered_tick": -1}),
        (CommandApplied, "answered_tick: ", {"answered_tick": 10_000_001}),
    ],
)
def test_message_is_refused_when_its_fields_contradict(
    cls: type[Message], words: str, fields: dict[str, object]
) -> None:
    check_refused(cls, words, EXAMPLES[cls].model_dump() | fields)


@given(st.sampled_from(CLASSES), st.data())
def test_message_is_refused_when_a_word_is_unknown(cls: type[Message], data: st.DataObject) -> None:
    choices = ("atom", "source", "reason", "kind", "status", "event", "purpose", "driver")
    known = [name for name in choices if name in cls.model_fields]
    if known:
        name = data.draw(st.sampled_from(known))
        word = "?" + data.draw(st.text(max_size=5))
        check_refused(cls, f"{name}: ", EXAMPLES[cls].model_dump() | {name: word})


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"atom": "up"}, "atom must be one of"),
        ({"speed": 2.0}, "angular: "),
        ({"speed": "fast"}, "atom must be one of"),
        ({"speed": math.nan}, "linear: "),
    ],
)
def test_command_is_a_velocity_when_a_key_is_given(wrong: dict[str, object], words: str) -> None:
    known = EXAMPLES[Command].model_dump(exclude={"linear", "angular"})
    fields = known | {"atom": "left", "speed": 0.5}
    assert Command.model_validate(fields).velocity == (0.0, 0.5)
    check_refused(Command, words, fields | wrong)
