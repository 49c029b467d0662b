"""Messages to bytes and back, with every limit checked before memory is spent."""

from functools import cache
from typing import Final, TypeVar

import msgpack
from pydantic import ValidationError

from schemas.base import Message

ENCODING_PREFIX: Final = "application/vnd.msgpack;"

M = TypeVar("M", bound=Message)


class DecodeError(ValueError):
    """A payload that is not the message it should be; the text says why in one line."""


@cache
def encoding_of(message: type[Message]) -> str:
    """Return the encoding that goes with a message class, for example ``application/vnd.msgpack;smal.State/1``."""
    return ENCODING_PREFIX + message.schema_name()


def misfit(message: type[Message], encoding: str, size: int) -> str | None:
    """Say why a payload of an encoding and a size cannot be a message of a class; None where it may be."""
    if encoding != encoding_of(message):
        return f"expected {encoding_of(message)}, got {encoding[:80]!r}"
    if size > message.max_bytes:
        return f"{message.schema_name()}: {size} bytes, at most {message.max_bytes} allowed"
    return None


def encode(message: Message) -> bytes:
    """Pack a message as msgpack: a map from field name to value; the same message always gives the same bytes."""
    packed: bytes = msgpack.packb(message.model_dump(), use_bin_type=True)
    return packed


def decode(cls: type[M], payload: bytes, encoding: str) -> M:
    """Unpack and validate one message of a class; DecodeError, and nothing else, for any payload that is none."""
    if (why := misfit(cls, encoding, len(payload))) is not None:
        raise DecodeError(why)
    try:
        # Few and small containers: four megabytes of empty maps would otherwise cost 1 s and 280 MB.
        count = _ContainerCount(cls.max_containers)
        fields = msgpack.unpackb(
            payload,
            use_list=False,
            list_hook=count,
            object_hook=count,
            max_str_len=4096,
            max_bin_len=cls.max_bytes,
            max_array_len=1024,
            max_map_len=64,
            max_ext_len=0,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(
            f"{cls.schema_name()}: not msgpack: {printable(str(error) or type(error).__name__)}"
        ) from None
    try:
        return cls.model_validate(fields)
    except ValidationError as error:
        raise DecodeError(f"{cls.schema_name()}: {describe(error)}") from None


def describe(error: ValidationError) -> str:
    """Say in one line what is wrong with the first bad field, what it may be, and how many others there are."""
    first, *others = error.errors(include_url=False, include_context=False)
    where = ".".join(str(part) for part in first["loc"]) or "message"
    more = f" (and {len(others)} more)" if others else ""
    # Which of Python's errors a rule of ours raises means nothing to who reads this.
    what = first["msg"].removeprefix("Value error, ")
    given = first["input"]
    subject, should, allowed = what.partition(" should ")
    if subject in ("Input", "String") and should and isinstance(given, str | int | float):
        what = f"{(given[:40] if isinstance(given, str) else given)!r} must {allowed.partition(', unable to parse')[0]}"
    what = what.replace("less than or equal to", "at most").replace(
        "greater than or equal to", "at least"
    )
    return f"{printable(where)}: {printable(what)}{more}"


class _ContainerCount:
    """Called by msgpack with every finished map and array; ends the unpacking when there are too many."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._seen = 0

    def __call__(self, container: object) -> object:
        self._seen += 1
        if self._seen > self._most:
            raise ValueError(f"more than {self._most} maps and arrays")
        return container


def printable(text: str, most: int = 200) -> str:
    """Return the beginning of a stranger's text, with nothing in it that moves a log or a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:most])
