"""What ``smal topic echo`` says of a sample: key, encoding and payload, a line each."""

from __future__ import annotations

import json
import random

from schemas.codec import encode, encoding_of
from services.cli.listening.samples import Sample
from tests.fuzz.targets import check_line
from tests.fuzz.targets.messages import changed_msgpack
from tests.schemas.messages import EXAMPLES


def seeds() -> list[bytes]:
    return [
        b"\n".join([f"smal/{message.robot}/{message.topic_name}".encode(), encoding_of(cls).encode(), encode(message)])
        for cls, message in EXAMPLES.items()
    ]


def run(data: bytes) -> bool:
    key, encoding, payload, *_ = [*data.split(b"\n", 2), b"", b""]
    sample = Sample(key.decode(errors="replace"), payload, encoding.decode(errors="replace"))
    # The line of a whole message is as long as its fields, of which the codec has checked every one.
    line = sample.line()
    assert line.isprintable()
    assert len(line) < 8000
    record = sample.record()
    assert record["key"] == sample.key
    if "error" in record:
        check_line(str(record["error"]))
    assert "\n" not in json.dumps(record, allow_nan=False)
    return "error" not in record


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    parts = data.split(b"\n", 2)
    payload = changed_msgpack(parts[2], rng) if len(parts) == 3 else None
    return None if payload is None else b"\n".join([*parts[:2], payload])
