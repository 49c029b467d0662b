"""Small recordings for the fuzzer, and changes in them that leave the frame of the format whole."""

from __future__ import annotations

import random
import struct
import zlib
from io import BytesIO
from typing import Final

import cv2
import lz4.frame
import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from schemas.base import Message
from services.recordings.records import MAGIC
from tests.fuzz.trees import changed_json
from tests.services.recordings.recorded_messages import applied, event, observation

_FRAME: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQI")
_LENGTH: Final = struct.Struct("<Q")
_MESSAGE_HEADER: Final = 22
_IMAGE_KEY: Final = "camera/jpeg"
_PACKERS: Final = {b"": bytes, b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}

Records = list[tuple[int, bytes]]


def image_payload(shade: int = 200) -> bytes:
    """Return a recorded image of 8 by 8 pixels."""
    _, jpeg = cv2.imencode(".jpg", np.full((8, 8, 3), shade, np.uint8))
    return bytes(CompressedImage(frame_id=_IMAGE_KEY, data=jpeg.tobytes(), format="jpeg").SerializeToString())


def recording(compression: CompressionType = CompressionType.NONE, *, finished: bool = True) -> bytes:
    """Return an episode of two frames, the second without features; with one schema, a short one."""
    messages: list[Message] = [
        event("e", 0, "started"), observation("e", 0), applied("e", 0), event("e", 1, "ended", "found"),
    ]  # fmt: skip
    file = BytesIO()
    writer = Writer(file, compression=compression)
    writer.start(profile="", library="smal")
    writer.add_metadata("smal.episode", {"robot": "rescuebot", "episode": "e"})
    parts = [(m.topic_name, m.tick, m.model_dump_json().encode()) for m in messages]
    channels: dict[str, int] = {}
    schema = writer.register_schema("smal.Any", "jsonschema", b"{}")
    for topic, tick, payload in [*parts[:3], (_IMAGE_KEY, 1, image_payload()), *parts[3:]]:
        if topic not in channels:
            metadata = {"robot": "rescuebot", "episode": "e"}
            channels[topic] = writer.register_channel(f"smal/rescuebot/{topic}", "json", schema, metadata)
        writer.add_message(channels[topic], tick, payload, tick, tick)
        writer.flush()
    if finished:
        writer.finish()
    return file.getvalue()


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change records, or the order of them; None where the file is too broken to see any."""
    found = _split(data[len(MAGIC) :]) if data.startswith(MAGIC) else []
    if not found or rng.random() < 0.2:
        return None
    at = rng.randrange(len(found))
    match rng.randrange(8):
        case 0:
            del found[at]
        case 1:
            found.insert(rng.randrange(len(found)), found[at])
        case 2:
            found[at] = (rng.randrange(18), found[at][1])
        case _:
            found[at] = (found[at][0], _changed_body(*found[at], rng))
    cut = _joined(found)
    ending = rng.choice([MAGIC, MAGIC, b"", b"\0" * rng.randrange(40)])
    return MAGIC + (cut[: rng.randrange(len(cut) + 1)] if rng.random() < 0.1 else cut) + ending


def _split(data: bytes) -> Records:
    found, at = [], 0
    while at + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, at)
        if at + _FRAME.size + length > len(data):
            break
        found.append((opcode, data[at + _FRAME.size :][:length]))
        at += _FRAME.size + length
    return found


def _joined(records: Records) -> bytes:
    return b"".join(_FRAME.pack(opcode, len(body)) + body for opcode, body in records)


def _changed_body(opcode: int, body: bytes, rng: random.Random) -> bytes:
    if opcode == Opcode.CHUNK and len(body) >= 40 and rng.random() < 0.85:
        return _changed_chunk(body, rng)
    if opcode == Opcode.MESSAGE and len(body) > _MESSAGE_HEADER and rng.random() < 0.7:
        payload = changed_json(body[_MESSAGE_HEADER:], rng)
        if payload is not None:
            return body[:_MESSAGE_HEADER] + payload
    return _changed_bytes(body, rng)


def _changed_bytes(body: bytes, rng: random.Random) -> bytes:
    changed = bytearray(body)
    for _ in range(rng.choice((1, 1, 2, 4)) if body else 0):
        changed[rng.randrange(len(changed))] = rng.choice((0, 1, 255, rng.randrange(256)))
    return bytes(changed[: rng.randrange(len(changed) + 1)] if rng.random() < 0.2 else changed)


def _changed_chunk(body: bytes, rng: random.Random) -> bytes:
    """Change a record in an uncompressed chunk; pack it, and lie about its size, now and then."""
    inner = _split(body[40:])
    if inner:
        at = rng.randrange(len(inner))
        inner[at] = (inner[at][0], _changed_body(*inner[at], rng))
    records = _joined(inner)
    name = rng.choice((b"", b"", b"", b"zstd", b"lz4"))
    size = rng.choice((len(records), len(records), len(records), 0, 2**30, 2**62, 2**64 - 1))
    checksum = rng.choice((0, 0, 0, 1, zlib.crc32(records)))
    packed = _PACKERS[name](records)
    start, end, _, _ = _CHUNK.unpack_from(body)
    return _CHUNK.pack(start, end, size, checksum) + _text(name) + _LENGTH.pack(len(packed)) + packed


def _text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text
