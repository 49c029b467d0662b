"""What came from the bus: as one line for ``smal topic echo``, as one JSON object, or the header alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import msgpack
from pydantic import ValidationError

from schemas.base import Message
from schemas.codec import DecodeError, decode, describe, misfit, printable
from schemas.topics import Topic, key_of, topic_of

MOST_ITEMS: Final = 12
#: The header is at most 143 bytes.
HEADER_BYTES: Final = 256


@dataclass(frozen=True)
class Sample:
    """One sample as it came from the bus."""

    key: str
    payload: bytes
    encoding: str

    def decoded(self) -> Message:
        """Return the message.

        Raises
        ------
        DecodeError
            When the key is no topic of SMAL, or the payload is not what belongs on it.
        """
        topic = topic_of(self.key)
        if topic is None:
            raise DecodeError("no topic of SMAL")
        message = decode(topic.message, self.payload, self.encoding)
        if key_of(message) != self.key:
            raise DecodeError(f"holds a message of {message.robot}/{message.topic_name}")
        return message

    def record(self) -> dict[str, object]:
        """Return the sample for JSON: the fields, or why there are none; of binary data the length only."""
        try:
            return {"key": self.key, "message": without_binary(self.decoded().model_dump())}
        except DecodeError as error:
            return {"key": self.key, "error": str(error), "bytes": len(self.payload)}

    def line(self) -> str:
        """Return the sample as one line for people."""
        try:
            fields = self.decoded().model_dump(exclude={"robot"})
        except DecodeError as error:
            return f"{printable(self.key)}  not decodable ({len(self.payload)} bytes): {error}"
        return f"{printable(self.key)}  " + " ".join(f"{name}={_text(value)}" for name, value in fields.items())


def header_of(topic: Topic, payload: bytes, encoding: str) -> Message:
    """Read robot, episode, tick and stamp off the beginning of a payload, and nothing else.

    It takes microseconds for any message, a raw image among them; the rest of the payload is not looked at.

    Raises
    ------
    DecodeError
        When the payload does not begin as a message of the topic does.
    """
    if (why := misfit(topic.message, encoding, len(payload))) is not None:
        raise DecodeError(why)
    unpacker = msgpack.Unpacker(max_buffer_size=HEADER_BYTES)
    unpacker.feed(payload[:HEADER_BYTES])
    fields: dict[str, object] = {}
    try:
        # Field by field, as they were written: the four of the header come first.
        for _ in range(min(unpacker.read_map_header(), len(Message.model_fields))):
            name = unpacker.unpack()
            fields[name] = unpacker.unpack()
        return Message.model_validate(fields)
    except ValidationError as error:
        raise DecodeError(f"{topic.name}: {describe(error)}") from None
    except (ValueError, TypeError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(f"{topic.name}: no header: {printable(str(error) or type(error).__name__)}") from None


def without_binary(value: object) -> object:
    """Return a copy of plain data in which every ``bytes`` has given way to its length."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    if isinstance(value, dict):
        return {name: without_binary(part) for name, part in value.items()}
    return value


def _text(value: object) -> str:
    match value:
        case {"dtype": dtype, "shape": tuple(shape), "data": bytes(data)}:
            return f"<{dtype} {'x'.join(map(str, shape))}, {len(data)} bytes>"
        case bytes():
            return f"<{len(value)} bytes>"
        case float():
            return f"{value:.6g}"
        case ({**first}, *more):
            # Of a belief this is the likeliest place.
            shown = " ".join(f"{name}={_text(part)}" for name, part in first.items())
            return f"({shown})" + (f",...({1 + len(more)})" if more else "")
        case tuple() if len(value) > MOST_ITEMS:
            return ",".join(map(str, value[:MOST_ITEMS])) + f",...({len(value)})"
        case tuple():
            return ",".join(map(str, value)) or "()"
        case None:
            return "-"
        case _:
            return printable(str(value))
