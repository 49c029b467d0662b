"""What came from the bus: as one line for ``smal topic echo``, or as one JSON object."""

from dataclasses import dataclass
from typing import Final

from schemas.base import Message
from schemas.codec import DecodeError, decode, printable
from schemas.topics import key_of, topic_of

MOST_ITEMS: Final = 12


@dataclass(frozen=True)
class Sample:
    """One sample as it came from the bus."""

    key: str
    payload: bytes
    encoding: str

    def decoded(self) -> Message:
        """Return the message; DecodeError where the key is no topic of SMAL, or the payload not what belongs on it."""
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
            return {"key": self.key, "message": _without_binary(self.decoded().model_dump())}
        except DecodeError as error:
            return {"key": self.key, "error": str(error), "bytes": len(self.payload)}

    def line(self) -> str:
        """Return the sample as one line for people."""
        try:
            fields = self.decoded().model_dump(exclude={"robot"})
        except DecodeError as error:
            return f"{printable(self.key)}  not decodable ({len(self.payload)} bytes): {error}"
        return f"{printable(self.key)}  " + " ".join(f"{name}={_text(value)}" for name, value in fields.items())


def _without_binary(value: object) -> object:
    """Return a copy of plain data in which every ``bytes`` has given way to its length."""
    if isinstance(value, bytes):
        return {"bytes": len(value)}
    if isinstance(value, dict):
        return {name: _without_binary(part) for name, part in value.items()}
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
