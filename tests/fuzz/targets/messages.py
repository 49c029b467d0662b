"""``schemas.codec.decode`` for every message class; the first byte of an input chooses the class."""

from __future__ import annotations

import json
import random

import msgpack

from schemas.codec import DecodeError, decode, encode, encoding_of
from schemas.topics import TOPICS
from tests.fuzz.targets import check_line
from tests.fuzz.trees import changed
from tests.schemas.messages import EXAMPLES, GOLDEN

CLASSES = list(dict.fromkeys(topic.message for topic in TOPICS.values()))


def seeds() -> list[bytes]:
    golden = json.loads(GOLDEN.read_text())
    whole = [bytes([number]) + bytes.fromhex(golden[cls.__name__]["hex"]) for number, cls in enumerate(CLASSES)]
    return whole + [bytes([number]) + encode(EXAMPLES[cls])[:40] for number, cls in enumerate(CLASSES)]


def run(data: bytes) -> bool:
    cls = CLASSES[data[0] % len(CLASSES)] if data else CLASSES[0]
    try:
        message = decode(cls, data[1:], encoding_of(cls))
    except DecodeError as error:
        check_line(error)
        return False
    # Whatever was let in can be sent on, and means the same there.
    again = encode(message)
    assert decode(cls, again, encoding_of(cls)) == message
    assert encode(decode(cls, again, encoding_of(cls))) == again
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    payload = changed_msgpack(data[1:], rng)
    return None if payload is None else data[:1] + payload


def changed_msgpack(payload: bytes, rng: random.Random) -> bytes | None:
    """Change what a payload says; None where it says nothing."""
    try:
        tree = changed(msgpack.unpackb(payload, strict_map_key=False, use_list=False), rng)
        return bytes(msgpack.packb(tree, use_single_float=rng.random() < 0.1))
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.exceptions.UnpackException):
        return None
