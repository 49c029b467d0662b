"""``decode`` turns any bytes into a valid message or a DecodeError of one line, at little cost."""

import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.action import Action
from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.codec import DecodeError, decode, encode, encoding_of
from schemas.command import Command
from schemas.episode import Episode
from schemas.motion import MAX_SAMPLES, Imu, ImuSample
from schemas.observation import MOST_DETECTED, Detected, Observation
from schemas.state import MAX_PLACES, State
from tests.places import places
from tests.schemas.messages import CLASSES, EXAMPLES, any_message

LARGEST = CompressedImage


def refusal(cls: type[Message], payload: bytes, encoding: str | None = None) -> str:
    with pytest.raises(DecodeError) as refused:
        decode(cls, payload, encoding or encoding_of(cls))
    text = str(refused.value)
    assert text.isprintable()
    assert len(text) < 500
    return text


def decode_or_refuse(cls: type[Message], payload: bytes) -> None:
    try:
        assert isinstance(decode(cls, payload, encoding_of(cls)), cls)
    except DecodeError:
        refusal(cls, payload)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_message_is_refused_when_it_is_cut_or_too_long(cls: type[Message]) -> None:
    payload = encode(EXAMPLES[cls])
    for length in range(len(payload)):
        refusal(cls, payload[:length])
    assert "extra data" in refusal(cls, payload + b"\xc0")
    assert "too large" in refusal(cls, bytes(cls.max_bytes + 1))


@pytest.mark.parametrize(
    "encoding",
    [
        " ",
        "application/json",
        "application/vnd.msgpack",
        "application/vnd.msgpack;smal.Command/2",
        "application/vnd.msgpack;smal.Command/1 ",
        "application/vnd.msgpack;smal.State/1",
        "\x1b[2J" * 100,
    ],
)
def test_message_is_refused_when_its_encoding_is_another(encoding: str) -> None:
    assert "expected application/vnd.msgpack;smal.Command/1" in refusal(
        Command, encode(EXAMPLES[Command]), encoding
    )


LARGEST_OF_EACH = [
    EXAMPLES[CompressedImage].model_copy(update={"data": bytes(16_000_000)}),
    Observation.after(
        EXAMPLES[CompressedImage],
        fingerprint="f" * 64,
        features=Float32Array.from_numpy(np.zeros(1_000_000, np.float32)),
    ),
    EXAMPLES[Observation].model_copy(
        update={
            "detected": (Detected(label="boxes 99", score=0.5, box=(0.0, 0.0, 1.0, 1.0)),)
            * MOST_DETECTED
        }
    ),
    State.after(
        EXAMPLES[CompressedImage],
        status="recognized",
        model="f" * 64,
        places=places(*[(1_000_000, 0.1, 0.1, 0.1, 0.01)] * MAX_PLACES),
        lost=0.1,
        cosine=0.1,
        tracked_m=0.1,
    ),
    Imu.after(
        EXAMPLES[CompressedImage],
        samples=tuple(
            ImuSample(
                after_s=k + 0.1, angular_velocity_rad_s=(0.1,) * 3, acceleration_m_s2=(0.1,) * 3
            )
            for k in range(MAX_SAMPLES)
        ),
    ),
    Action.after(
        EXAMPLES[CompressedImage], kind="look_around", state=1_000_000, atoms=("backward",) * 1000
    ),
    Episode.after(
        EXAMPLES[CompressedImage],
        event="started",
        purpose="recovery",
        driver="emergency_stop",
        world="é" * 255,
        seed=1,
    ),
]


@pytest.mark.parametrize("message", LARGEST_OF_EACH, ids=lambda message: type(message).__name__)
def test_largest_message_of_each_class_fits(message: Message) -> None:
    cls = type(message)
    assert decode(cls, encode(message), encoding_of(cls)) == message


@given(any_message(), st.data())
def test_message_is_decoded_or_refused_when_a_byte_changes(
    message: Message, data: st.DataObject
) -> None:
    payload = bytearray(encode(message))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    decode_or_refuse(type(message), bytes(payload))


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text()
    | st.binary(),
    lambda parts: (
        st.lists(parts, max_size=4) | st.dictionaries(st.text() | st.binary(), parts, max_size=4)
    ),
)


@given(st.sampled_from(CLASSES), st.binary(max_size=200) | plain.map(msgpack.packb))
def test_message_is_refused_when_it_is_any_bytes(cls: type[Message], payload: bytes) -> None:
    refusal(cls, payload)


@given(st.sampled_from(CLASSES), st.data())
def test_message_is_decoded_or_refused_when_a_field_changes(
    cls: type[Message], data: st.DataObject
) -> None:
    fields = EXAMPLES[cls].model_dump()
    fields[data.draw(st.sampled_from(list(fields)))] = data.draw(plain)
    decode_or_refuse(cls, msgpack.packb(fields))


@pytest.mark.parametrize(
    "payload",
    [
        b"\xd6\xff" + bytes(4),  # timestamps and other extension types
        b"\xd7\xff" + b"\xff" * 8,
        b"\xc7\x0c\xff" + b"\xff" * 12,
        b"\xd4\x05\x00",
        b"\x81\x01\x02",  # a number, an array and a map as keys
        b"\x81\x90\x01",
        b"\x81\x80\x01",
        b"\xa2\xff\xff",  # text that is no UTF-8
        b"\xc1",  # never used
        b"\xdd\xff\xff\xff\xff",  # four billion elements announced
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
    ],
    ids=bytes.hex,
)
def test_msgpack_is_refused_when_it_is_no_message(payload: bytes) -> None:
    refusal(LARGEST, payload)


def blown_up(leaf: bytes, size: int) -> bytes:
    """Arrays of 1024 arrays of 1024 leaves each, ``size`` bytes in all."""
    row = b"\xdc\x04\x00" + leaf * 1024
    block = b"\xdc\x04\x00" + row * 1024
    count = -(-size // len(block))
    return bytes([0x90 + count]) + block * count


@pytest.mark.parametrize(
    "leaf", [b"\x80", b"\x90", b"\x91\xc0", b"\x81\xa1a\xc0", b"\xcd\xff\xff"], ids=bytes.hex
)
def test_four_megabytes_of_containers_cost_little(leaf: bytes) -> None:
    """By default msgpack makes 280 MB of these bytes and takes a second."""
    payload = blown_up(leaf, 4_000_000)
    assert 4_000_000 <= len(payload) < LARGEST.max_bytes
    tracemalloc.start()
    refusal(LARGEST, payload)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 8_000_000


def test_message_is_copied_once_when_it_is_large() -> None:
    image = EXAMPLES[CompressedImage].model_copy(update={"data": bytes(15_000_000)})
    payload = encode(image)
    tracemalloc.start()
    assert decode(CompressedImage, payload, encoding_of(CompressedImage)) == image
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 1.1 * len(payload)


def test_error_is_one_line_when_a_field_name_has_control_codes() -> None:
    payload = msgpack.packb(
        EXAMPLES[Command].model_dump() | {"x\n12:00 INFO all is well\x1b[2J": 1}
    )
    assert "Extra inputs" in refusal(Command, payload)


def test_describe_names_the_field_and_counts_the_others() -> None:
    with pytest.raises(
        DecodeError, match=r"^smal.Observation/1: robot: Field required \(and 5 more\)$"
    ):
        decode(Observation, b"\x80", encoding_of(Observation))
